"""Strain inside soft tissue from pairs of MR images, and how far a finite-element model of it may be trusted.

The roof of the house: command line, study file, pipeline, provenance, doctor. It parses, wires and prints;
what computes lies in `dvc`, `fe`, `phantoms` and `validate`. Importing it loads none of them: the functions below,
which do what the commands of these names do, load what they need when they are first asked for.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
