"""How far a measurement may be trusted: quality, verdict, figures by region, error model and intervals."""
