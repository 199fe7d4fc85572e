"""Finite-element models compared with measured deformation: how large the difference is, where, and whether it counts.

Public interface; each name is loaded when it is first used. All geometry is LPS mm in the reference (unloaded)
configuration unless a docstring says otherwise. Imports from `phantoms`, `fe` and `dvc`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
