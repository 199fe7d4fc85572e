"""The engines that there are, by name: the one place where a new engine is entered."""

from collections.abc import Mapping
from typing import Any

from dvc.errors import ParameterError
from dvc.registration.elastix.engine import Elastix
from dvc.registration.elastix.presets import load_preset, preset_names, read_parameter_file
from dvc.registration.engine import Engine
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces

_SMOOTH = GaussNewton()
DEFAULT = GaussNewton.name
"""Name of the engine that is used unless another is asked for."""
_OURS = GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces
ENGINES: dict[str, type[Engine]] = {kind.name: kind for kind in _OURS}
"""Engines that are known by one name. elastix is known by its presets and parameter files."""


def default_engine(smooth: GaussNewton = _SMOOTH, *, labelled: bool, on_bone: bool) -> Engine:
    """The Gauss-Newton engine with every strain discontinuity that the input allows.

    At the tissue interfaces of a label map (``labelled``), else at the surface of the bone that images are aligned on
    (``on_bone``), else nowhere.
    """
    if labelled:
        return GaussNewtonWithInterfaces(smooth)
    return GaussNewtonAtBone(smooth) if on_bone else smooth


def families() -> list[str]:
    """Names that engines are asked for by; an engine with and without tissue interfaces has one."""
    return sorted({Elastix.family, *(kind().family for kind in ENGINES.values())})


def engine_named(name: str) -> Engine:
    """An engine by its name: gauss-newton, -bone or -borders, a preset of elastix, or a parameter file (.txt).

    Raises
    ------
    ParameterError, InputError
        If there is no such engine or preset, or the file cannot be used.
    """
    if name in ENGINES:
        return ENGINES[name]()
    if name.endswith(".txt"):
        return Elastix((read_parameter_file(name),))
    if name not in preset_names():
        known = ", ".join((*ENGINES, *preset_names()))
        raise ParameterError(f"Unknown engine or preset '{name}'; use {known}, or an elastix parameter file (.txt).")
    return Elastix((load_preset(name),))


def methods_of(record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
    """How a displacement was found, for a methods section, from the parameters in a provenance record.

    Empty where no engine is recorded.
    """
    kinds: list[type[Engine]] = [*ENGINES.values(), Elastix]
    known = record.get("engine")
    unknown = f"with the engine {known} of mrstrain {versions.get('mrstrain', '?')}" if known else ""
    return next(filter(None, (kind.methods(record, versions) for kind in kinds)), unknown)
