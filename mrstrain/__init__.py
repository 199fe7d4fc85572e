"""Strain inside soft tissue from pairs of MR images, and the comparison of finite-element models with it.

The commands as functions: each takes paths and writes a folder. For arrays see `dvc`, `fe`, `validate` and `phantoms`.
Importing it loads none of them: a function loads what it needs when it is first used.
"""

from typing import Any

import lazy_loader

__version__ = "0.1.0"
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """One of the commands; ImportError where ``dvc`` or ``validate`` belongs to another distribution."""
    if name in __all__:
        from mrstrain.records.doctor import refuse_foreign_packages

        refuse_foreign_packages()
    return _load(name)
