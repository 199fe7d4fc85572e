"""Names of `dvc` that a user of `fe` needs as well."""

from dvc import TetMesh
from dvc.errors import InputError, MrstrainError, OutputError, WorkerError

__all__ = ["InputError", "MrstrainError", "OutputError", "TetMesh", "WorkerError"]
