"""Strain inside soft tissue from pairs of MR images, and how far a finite-element model of it may be trusted.

The roof of the house: command line, study file, pipeline, provenance, doctor. It parses, wires and prints;
what computes lies in `dvc`, `fe`, `phantoms` and `validate`. Importing it loads none of them: the functions below,
which do what the commands of these names do, load what they need when they are first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrstrain.comparison.compare import compare
    from mrstrain.comparison.drive import drive
    from mrstrain.comparison.level import level
    from mrstrain.measurement.register import register
    from mrstrain.measurement.strain import strain
    from mrstrain.models.converge import converge
    from mrstrain.models.fit import fit
    from mrstrain.models.mesh import mesh
    from mrstrain.models.simulate import simulate
    from mrstrain.studies.check import check
    from mrstrain.studies.cohort import cohort
    from mrstrain.studies.init import init
    from mrstrain.studies.run import run
    from mrstrain.truth.accuracy import accuracy
    from mrstrain.truth.phantom import phantom
    from mrstrain.truth.twin import twin

__version__ = "0.1.0"
__all__ = [
    "accuracy",
    "check",
    "cohort",
    "compare",
    "converge",
    "drive",
    "fit",
    "init",
    "level",
    "mesh",
    "phantom",
    "register",
    "run",
    "simulate",
    "strain",
    "twin",
]

_ROOMS = {
    "accuracy": "truth.accuracy",
    "check": "studies.check",
    "cohort": "studies.cohort",
    "compare": "comparison.compare",
    "converge": "models.converge",
    "drive": "comparison.drive",
    "fit": "models.fit",
    "init": "studies.init",
    "level": "comparison.level",
    "mesh": "models.mesh",
    "phantom": "truth.phantom",
    "register": "measurement.register",
    "run": "studies.run",
    "simulate": "models.simulate",
    "strain": "measurement.strain",
    "twin": "truth.twin",
}


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return getattr(import_module(f"mrstrain.{_ROOMS[name]}"), name)
    raise AttributeError(f"mrstrain has no attribute {name!r}")
