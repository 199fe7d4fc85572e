"""Strain inside soft tissue from pairs of MR images, and how far a finite-element model of it may be trusted.

The roof of the house: command line, study file, pipeline, provenance, doctor. It parses, wires and prints;
what computes lies in `dvc`, `fe`, `phantoms` and `validate`. Importing it loads none of them: the functions below,
which do what the commands of these names do, load what they need when they are first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrstrain.beginning import init
    from mrstrain.checking import check
    from mrstrain.comparing import compare
    from mrstrain.converging import converge
    from mrstrain.driving import drive
    from mrstrain.fitting import fit
    from mrstrain.levelling import level
    from mrstrain.making import phantom
    from mrstrain.meshing import mesh
    from mrstrain.registering import register
    from mrstrain.running import run
    from mrstrain.simulating import simulate
    from mrstrain.straining import strain
    from mrstrain.studying import accuracy
    from mrstrain.subjects import cohort
    from mrstrain.twinning import twin

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
    "accuracy": "studying",
    "check": "checking",
    "cohort": "subjects",
    "compare": "comparing",
    "converge": "converging",
    "drive": "driving",
    "fit": "fitting",
    "init": "beginning",
    "level": "levelling",
    "mesh": "meshing",
    "phantom": "making",
    "register": "registering",
    "run": "running",
    "simulate": "simulating",
    "strain": "straining",
    "twin": "twinning",
}


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return getattr(import_module(f"mrstrain.{_ROOMS[name]}"), name)
    raise AttributeError(f"mrstrain has no attribute {name!r}")
