"""Agreement of a finite-element model with a measurement.

Two deformations on one mesh give the volume of tissue above each strain, where the strained tissue lies, the
agreement point by point, and a report. Imports from `phantoms`, `fe` and `dvc`.
"""
