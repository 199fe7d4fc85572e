"""Strain inside soft tissue from pairs of MR images, and how far a finite-element model of it may be trusted.

The roof of the house: command line, study file, pipeline, provenance, doctor. It parses, wires and prints;
what computes lies in `dvc`, `fe`, `phantoms` and `validate`. Importing it loads none of them: `register`, `strain` and
`phantom`, which do what the commands of these names do, load what they need when they are first asked for.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrstrain.making import phantom
    from mrstrain.registering import register
    from mrstrain.straining import strain

__version__ = "0.1.0"
__all__ = ["phantom", "register", "strain"]


def __getattr__(name: str) -> Any:
    if name == "phantom":
        from mrstrain.making import phantom

        return phantom
    if name == "register":
        from mrstrain.registering import register

        return register
    if name == "strain":
        from mrstrain.straining import strain

        return strain
    raise AttributeError(f"mrstrain has no attribute {name!r}")
