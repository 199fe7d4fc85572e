"""`init`, `check`, `run`, `cohort` and `demo`: complete studies from one study file, stage by stage."""
