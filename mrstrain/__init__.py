"""Strain inside soft tissue from pairs of MR images, and how far a finite-element model of it may be trusted.

The commands as functions: each takes paths and writes a folder. For arrays see `dvc`, `fe`, `validate` and `phantoms`.
Importing it loads none of them: a function loads what it needs when it is first used.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
