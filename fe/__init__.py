"""Finite-element models of soft tissue under load.

From a label map to a conforming tetrahedral mesh, material laws with published parameter sets, the fitting
of a law to a stretch-stress curve, a solver for nearly incompressible tissue under a rigid plate, and decks
for other solvers. Imports from `dvc` only.
"""
