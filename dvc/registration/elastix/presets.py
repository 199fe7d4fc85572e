"""Registration parameters: the named presets, users' own elastix files, and the check of both.

elastix ignores a misspelt parameter in silence. Here every name, and the name of every component, is compared
with those that elastix knows before anything runs.
"""

import difflib
import json
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from dvc.errors import InputError, ParameterError
from dvc.io.transforms.elastix_text import parse_parameters

_FOLDER = files("dvc.registration.elastix") / "parameters"
_KINDS = "Metric|Transform|Optimizer|Interpolator|ImageSampler|FixedImagePyramid|MovingImagePyramid|Registration"
_LABEL = re.compile(rf"^({_KINDS})\d*")

_COUNTS = {"NumberOfResolutions": (1, 20), "MaximumNumberOfIterations": (0, 1_000_000)}
"""Numbers by which elastix, and the time left, count: the least and the most."""
SPACING = "FinalGridSpacingInPhysicalUnits"
"""Distance of control points, mm, which mrstrain adapts to the voxels."""

# What mrstrain itself decides, so that results are reproducible and can be read back.
_ALWAYS: dict[str, tuple[str, ...]] = {
    "FixedImageDimension": ("3",), "MovingImageDimension": ("3",),
    "FixedInternalImagePixelType": ("float",), "MovingInternalImagePixelType": ("float",),
    "UseDirectionCosines": ("true",), "DefaultPixelValue": ("0",),
    "WriteResultImage": ("false",), "WriteFinalTransformParameters": ("false",), "WriteIterationInfo": ("true",),
    "Resampler": ("DefaultResampler",), "ResampleInterpolator": ("FinalBSplineInterpolator",),
    "ResultImageFormat": ("nii.gz",),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Preset:
    """elastix parameters with a name and the text they came from.

    Attributes
    ----------
    name : str
        Name of the preset, or of the user's file.
    text : str
        The file as written; kept for provenance.
    parameters : dict
        Parameter name to values, all as text.
    """

    name: str
    text: str
    parameters: dict[str, tuple[str, ...]]

    def complete(self, *, seed: int, combine: str = "Compose") -> dict[str, tuple[str, ...]]:
        """All parameters of a run: the preset's, those that mrstrain fixes for every run, and the seed of elastix.

        An initial transform is combined with the one sought as `combine` says, "Compose" or "Add".
        """
        return self.parameters | _ALWAYS | {"HowToCombineTransforms": (combine,), "RandomSeed": (str(seed),)}

    @property
    def iterations(self) -> int:
        """Iterations over all resolutions, for the time left."""
        resolutions = int(self.parameters.get("NumberOfResolutions", ("3",))[0])
        limits = self.parameters.get("MaximumNumberOfIterations", ("500",))
        return sum(int(limits[min(r, len(limits) - 1)]) for r in range(resolutions))

    @property
    def transform(self) -> str:
        """Elastix' name of the transform sought."""
        return self.parameters["Transform"][0]


def preset_names() -> list[str]:
    """Names of the presets that can be asked for."""
    return sorted(f.name.removesuffix(".txt") for f in _FOLDER.iterdir() if f.name.endswith(".txt"))


def load_preset(name: str) -> Preset:
    """A preset by its name.

    Raises
    ------
    ParameterError
        If there is none of that name; the message lists those there are.

    Examples
    --------
    >>> load_preset("heel-mr").parameters["Metric"]
    ('AdvancedNormalizedCorrelation',)
    """
    if name not in preset_names():
        raise ParameterError(f"Unknown preset '{name}'; choose one of {', '.join(preset_names())}.")
    return _checked(name, (_FOLDER / f"{name}.txt").read_text(), allow_unknown=False)


def read_parameter_file(path: Path | str, *, allow_unknown: bool = False) -> Preset:
    """A user's own elastix parameter file, checked.

    Parameters
    ----------
    allow_unknown : bool
        Accept parameter names that mrstrain does not know (a newer elastix may have more).

    Raises
    ------
    InputError
        If the file cannot be read.
    ParameterError
        For a name or component that elastix does not know; the message gives the closest known name.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as failure:
        raise InputError(f"{path}: the elastix parameter file cannot be read ({failure}).") from failure
    return _checked(Path(path).name, text, allow_unknown=allow_unknown)


def _checked(name: str, text: str, *, allow_unknown: bool) -> Preset:
    try:
        parameters = parse_parameters(text)
    except ParameterError as failure:
        raise ParameterError(f"{name}: {failure}") from failure
    names, components_of = _known()
    for parameter in () if allow_unknown else parameters:
        bare = _LABEL.sub("", parameter)  # without the metric's label
        spellings = {parameter, parameter.rstrip("0123456789"), bare}
        if not names & spellings and not (_LABEL.match(parameter) and "Metric" + bare in names):
            raise ParameterError(
                f"{name}: elastix has no parameter '{parameter}' and would ignore it without a message; "
                f"{_nearest(parameter, names)} If the name is correct, pass --allow-unknown-parameters."
            )
    for kind, components in components_of.items():
        for value in parameters.get(kind, ()):
            if value not in components:
                raise ParameterError(f'{name}: elastix has no {kind} "{value}"; {_nearest(value, components)}')
    for parameter, values in parameters.items():
        if odd := [value for value in values if not _could_be_meant(value)]:
            raise ParameterError(f"{name}: {parameter} has the value '{odd[0]}', which is not finite.")
        least, most = _COUNTS.get(parameter, (0, 0))
        if most and not (values and all(re.fullmatch(r"\d{1,9}", v) and least <= int(v) <= most for v in values)):
            given = " ".join(values)[:40]
            raise ParameterError(f"{name}: {parameter} takes whole numbers from {least} to {most}; it has '{given}'.")
    lengths = parameters.get(SPACING, ())
    if SPACING in parameters and not (lengths and all(map(_is_length, lengths))):
        given = " ".join(lengths)[:40]
        raise ParameterError(f"{name}: {SPACING} takes lengths above 0 mm; it has '{given}'.")
    if not parameters.get("Transform"):
        raise ParameterError(f'{name}: (Transform "...") is missing; give a B-spline or Euler transform.')
    return Preset(name, text, parameters)


def _could_be_meant(value: str) -> bool:
    """Whether a value is a word or a finite number."""
    with suppress(ValueError):
        return math.isfinite(float(value))
    return True


def _is_length(value: str) -> bool:
    """Whether a value is a number above 0; all are finite."""
    with suppress(ValueError):
        return float(value) > 0.0
    return False


def _nearest(name: str, known: Sequence[str] | frozenset[str]) -> str:
    near = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.5)
    return f"the closest known name is '{near[0]}'." if near else "no known name is similar."


@cache
def _known() -> tuple[frozenset[str], dict[str, list[str]]]:
    """Names of elastix' parameters, and of its components by the parameter that names them."""
    known = json.loads((_FOLDER / "known.json").read_text())
    return frozenset(known["parameters"]), known["components"]
