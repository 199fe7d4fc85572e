"""Synthetic image pairs with exactly known strain, and the error of a registration measured on them.

The public surface. A right heel defined in space (`Heel`), motions of its tissue with exact gradient and inverse, MR
images of both (`scan`, `heel_pair`), warps of a subject's own image (`synthetic_warp`), accuracy runs (`measure_run`),
their error tables, and the error model fitted to them (`fit_error_model`).

Points and displacements are LPS mm in the reference (unloaded) configuration unless a docstring says otherwise.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
