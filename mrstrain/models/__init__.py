"""`mesh`, `simulate`, `converge` and `fit`: finite-element models made, loaded and fitted."""
