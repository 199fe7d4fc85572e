"""Measured deformation: MR images, alignment on bone, B-spline registration, strain, and how far to trust it.

The public surface; a name is loaded when it is first used. All geometry is LPS mm in the reference (unloaded)
configuration unless a docstring says otherwise.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
