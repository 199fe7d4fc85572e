"""Names of `dvc` that a user of `phantoms` needs as well."""

from dvc.errors import GeometryError, InputError, MrstrainError

__all__ = ["GeometryError", "InputError", "MrstrainError"]
