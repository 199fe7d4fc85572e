"""Names of `dvc` that a user of `validate` needs as well."""

from dvc.errors import GeometryError, InputError, OutputError

__all__ = ["GeometryError", "InputError", "OutputError"]
