"""`mesh`, `simulate`, `converge` and `fit`: meshing, simulation, mesh convergence and material fits."""
