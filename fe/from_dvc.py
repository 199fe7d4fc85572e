"""Names of `dvc` that users of `fe` also need."""

from dvc import TetMesh
from dvc.errors import InputError, MrstrainError, OutputError, WorkerError

__all__ = ["InputError", "MrstrainError", "OutputError", "TetMesh", "WorkerError"]
