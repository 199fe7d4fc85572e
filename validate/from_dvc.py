"""Names of `dvc` that users of `validate` also need."""

from dvc.errors import GeometryError, InputError, OutputError

__all__ = ["GeometryError", "InputError", "OutputError"]
