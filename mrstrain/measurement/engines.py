"""The engine that a command registers with, by the flat options that it was asked with."""

from dvc import (
    Elastix,
    Engine,
    GaussNewton,
    GaussNewtonAtBone,
    GaussNewtonWithInterfaces,
    load_preset,
    read_parameter_file,
)
from dvc.errors import InputError, ParameterError
from dvc.registration.engines import DEFAULT, ENGINES, default_engine
from dvc.registration.gauss_newton.fit import USUAL_VOLUME
from mrstrain.options.measurement import EngineOptions, RegistrationOptions

GAUSS_NEWTON, ELASTIX = GaussNewton.family, Elastix.family
AT_BONE, WITH_LABELS = GaussNewtonAtBone().name, GaussNewtonWithInterfaces().name
"""The engines of a registration with a mask of the bone alone, and with a label map."""


def _asked(how: EngineOptions) -> str:
    """The engine asked for; where none is, elastix if a preset or parameter files are given, else the default."""
    return how.engine or (ELASTIX if how.preset or how.parameters else DEFAULT)


def volume_kept(how: EngineOptions) -> float | None:
    """The weight ``volume`` with which an engine keeps volume whatever the images ask for; None for one without it."""
    return USUAL_VOLUME if _asked(how) == GAUSS_NEWTON else None


def engine_of(how: RegistrationOptions, *, labelled: bool = False) -> Engine:
    """The engine asked for, with its preset, parameter files or weights; options of another engine are refused.

    The Gauss-Newton engine allows strain discontinuities at tissue interfaces with a label map (``labelled``), and at
    the surface of the bone without one, if images are aligned on it; nowhere if ``borders`` is False.
    """
    name, preset, parameters = _asked(how), how.preset, how.parameters
    bending, volume, borders = how.bending, how.volume, how.borders
    if name != ELASTIX and (parameters or preset):
        raise ParameterError(
            f"Presets and parameter files are for elastix, but the engine is {name} (its weights are bending and "
            "volume). Leave the engine out, or set it to elastix."
        )
    if name == GAUSS_NEWTON:
        smooth = GaussNewton(bending=bending, volume=volume)
        if borders is False:
            return smooth
        if borders and not labelled and how.align != "bone":
            raise InputError(
                "`borders` (--borders) needs a label map (`labels`), or images that are aligned on the bone (`align`). "
                "Give one of these, or leave out `borders`."
            )
        return default_engine(smooth, labelled=labelled, on_bone=how.align == "bone")
    if bending is not None or volume is not None:
        raise ParameterError(f"bending and volume are only for the engine {GAUSS_NEWTON}; the engine is {name}.")
    if borders:
        raise ParameterError(f"borders is only for the engine {GAUSS_NEWTON}; {name} fits one smooth spline.")
    if name != ELASTIX:
        return ENGINES[name]()
    if parameters and preset:
        raise ParameterError(f"Both the preset {preset} and parameter files were given; use only one of them.")
    files = tuple(read_parameter_file(p, allow_unknown=how.allow_unknown_parameters) for p in parameters)
    return Elastix(files or (load_preset(preset or "heel-mr"),))
