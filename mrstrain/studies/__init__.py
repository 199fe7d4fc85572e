"""`init`, `check`, `run`, `cohort` and `demo`: whole studies from one file, stage by stage."""
