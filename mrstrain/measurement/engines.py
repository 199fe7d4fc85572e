"""Which engine a command is to register with, by what it was asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dvc.errors import InputError, ParameterError
from dvc.registration.elastix.presets import read_parameter_file
from dvc.registration.gauss_newton.fit import GaussNewton
from dvc.registration.gauss_newton.with_borders import AtBorders
from dvc.registration.register import GAUSS_NEWTON, Settings


def engine_of(engine: str | None, preset: str | None, parameters: Sequence[Path | str]) -> str:
    """The engine asked for; where none is, elastix if a preset or parameter files are given, else our own."""
    return engine or ("elastix" if preset or parameters else GAUSS_NEWTON)


def settings_of(
    engine: str | None,
    preset: str | None,
    parameters: Sequence[Path | str] = (),
    *,
    bending: float | None = None,
    volume: float | None = None,
    borders: bool | None = None,
    labelled: bool = False,
    allow_unknown: bool = False,
) -> Settings:
    """The engine asked for, with its preset, parameter files or weights; what belongs to the other one is refused.

    Our own engine lets strain jump at the borders of tissues where ``labelled``, a label map tells them, unless it is
    told not to.

    Raises
    ------
    ParameterError
    InputError
        For borders of tissues that no label map tells.
    """
    engine = engine_of(engine, preset, parameters)
    if engine not in {"elastix", GAUSS_NEWTON}:
        raise ParameterError(f"No engine '{engine}'; there are elastix and {GAUSS_NEWTON}.")
    if engine == "elastix":
        if bending is not None or volume is not None:
            raise ParameterError(f"bending and volume are weights of the engine {GAUSS_NEWTON}; elastix has none.")
        if borders:
            raise ParameterError(f"borders are for the engine {GAUSS_NEWTON}: elastix finds one smooth spline.")
        if parameters and preset:
            raise ParameterError(
                f"Give the preset {preset} or parameter files, not both: only one of them would be used."
            )
        if parameters:
            return Settings(tuple(read_parameter_file(p, allow_unknown=allow_unknown) for p in parameters))
        return Settings.of(preset or "heel-mr")
    if parameters or preset:
        raise ParameterError(
            f"Presets and parameter files are elastix'; the engine {GAUSS_NEWTON} takes weights: bending and volume. "
            "Leave the engine out, or name elastix."
        )
    if borders and not labelled:
        raise InputError("Borders need the tissues: give a label map of the unloaded image (labels).")
    own = GaussNewton(bending=bending, volume=volume)
    return Settings(gauss_newton=own, borders=AtBorders() if labelled and borders is not False else None)
