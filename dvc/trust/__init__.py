"""How far a measurement may be trusted: quality, verdict, statistics by region, error model and intervals."""
