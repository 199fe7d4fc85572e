"""The elastix engine: one or more stages of elastix, each of which adds to the B-spline of the one before."""

import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Deformation
from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.images.image import Grid, Mask
from dvc.images.resample import fill_missing
from dvc.io.transforms.elastix_text import parse_parameters
from dvc.io.transforms.read import bspline_from_elastix
from dvc.io.transforms.write import write_elastix_transform
from dvc.registration.elastix import run as elastix
from dvc.registration.elastix.presets import SPACING, Preset, load_preset
from dvc.registration.engine import AlignedPair, Cost, Engine, Found, Progress
from dvc.worker import Worker

_log = logging.getLogger("dvc.registration.elastix.engine")

_LEAST_VOXELS = 2.0


@dataclass(frozen=True, slots=True)
class Elastix(Engine):
    """elastix with presets or parameter files.

    Attributes
    ----------
    presets : tuple of Preset
        Stages in sequence; each starts from the coefficients of the previous one. "heel-mr" by default.

    Raises
    ------
    ParameterError
        If there is no stage, a stage is not a B-spline, or two stages end with different control point spacings.
    """

    presets: tuple[Preset, ...] = field(default_factory=lambda: (load_preset("heel-mr"),))

    family = "elastix"
    starts_anywhere = False
    sees_brightness = False  # its metrics are correlation and mutual information
    cost = Cost(seconds=20.0, phantom_seconds=75.0, gib=0.75)  # 3,500 iterations, whatever the voxel

    def __post_init__(self) -> None:
        if not self.presets:
            raise ParameterError("No registration stage was given; pass a preset or parameter files.")
        for preset in self.presets:
            if "BSplineTransform" not in preset.transform:
                raise ParameterError(
                    f'{preset.name}: (Transform "{preset.transform}") is not a B-spline; the non-rigid stage needs '
                    '"RecursiveBSplineTransform" or "BSplineTransform".'
                )
        given = (preset.parameters for preset in self.presets)
        spacings = {p.get(SPACING, p.get("FinalGridSpacingInVoxels", ("default",))) for p in given}
        if len(spacings) > 1:
            raise ParameterError(
                f"The stages end with different control point spacings: {sorted(map(' '.join, spacings))}. Each stage "
                f"starts from the coefficients of the previous one, so {SPACING} must be equal in all stages."
            )

    @property
    def name(self) -> str:
        """Name of the last preset or parameter file, which also names the error model."""
        return self.presets[-1].name

    @property
    def text(self) -> str:
        """The parameters of all stages, as written."""
        return "\n".join(preset.text for preset in self.presets)

    @property
    def needs_one_contrast(self) -> bool:
        """Whether the two images must have the same contrast; not for mutual information."""
        metrics = [metric for preset in self.presets for metric in preset.parameters.get("Metric", ())]
        return not any("MutualInformation" in metric for metric in metrics)

    @property
    def seeds(self) -> int:
        """Number of independent seeds: one for each stage."""
        return len(self.presets)

    @property
    def without_error_model(self) -> str:
        """Why there can be no error model for it; empty for a single stage."""
        several = len(self.presets) > 1
        return "The error of several elastix stages in sequence has not been measured." if several else ""

    def check_start(self, start: Deformation) -> None:
        """InputError for a start that is not a B-spline."""
        _as_bspline(start)

    def record(self) -> dict[str, object]:
        """Its parameters as plain values, for provenance."""
        stages = [{"name": preset.name, "text": preset.text} for preset in self.presets]
        return {"gauss_newton": None, "borders": None, "stages": stages}

    @classmethod
    def methods(cls, record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        """Methods text from the parameters of a provenance record; empty if another engine was used."""
        stages = record.get("stages") or []
        if not stages or record.get("gauss_newton"):
            return ""
        return (
            f"with elastix (Klein 2010, Shamonin 2014; itk-elastix {versions.get('itk-elastix', '?')}) through "
            f"mrstrain {versions.get('mrstrain', '?')}: {'; then '.join(_stage_methods(stage) for stage in stages)}"
        )

    def find(
        self, pair: AlignedPair, *, start: Deformation | None, seeds: Sequence[int], worker: Worker, progress: Progress
    ) -> Found:
        """Find the displacement between the images of a pair; as in `Engine`."""
        last = None if start is None else _as_bspline(start)
        missing = pair.moving.missing
        known = Mask(pair.moving.grid, ~missing) if missing.any() else None
        here = replace(pair, fixed=fill_missing(pair.fixed), moving=fill_missing(pair.moving)).cut()
        for number, (preset, seed) in enumerate(zip(self.presets, seeds, strict=True), start=1):
            stage = "registering" if len(self.presets) == 1 else f"registering, stage {number}"
            last = _one_stage(preset, here, known, seed, last, worker, partial(progress, stage))
        assert last is not None
        return Found(last)


def _as_bspline(start: Deformation) -> BSpline:
    if isinstance(start, BSpline):
        return start
    raise InputError(
        f"elastix can start only from one B-spline; got {type(start).__name__}. Start from a result without tissue "
        "interfaces, or register with gauss-newton."
    )


def _one_stage(
    preset: Preset, pair: AlignedPair, moving_mask: Mask | None, seed: int, start: BSpline | None, worker: Worker,
    tell: Callable[[float], None],
) -> BSpline:  # fmt: skip
    """Displacement by one stage, added to that of the stage or load before it, ``start``."""
    grid = pair.fixed.grid
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        initial = start and str(write_elastix_transform(Path(folder), start, None, grid)[0])
        run = _resolvable(preset.complete(seed=seed, combine="Compose" if start is None else "Add"), grid)
        found = worker.run(
            f"registering with {preset.name}", elastix.register, pair.fixed, pair.moving, run, pair.compared,
            moving_mask, initial, folder,
            watch=lambda: tell(min(1.0, elastix.finished_iterations(Path(folder)) / preset.iterations)),
        )  # fmt: skip
    tell(1.0)
    bspline = bspline_from_elastix(found)
    if not np.isfinite(bspline.coefficients_mm).all():
        what = "the elastix optimiser diverged (coefficients are not finite)"
        raise RegistrationError(f"{preset.name}: {what}. Use a preset, or set a smaller MaximumStepLength.")
    return bspline.plus(start) if start is not None else bspline


def _resolvable(parameters: dict[str, tuple[str, ...]], grid: Grid) -> dict[str, tuple[str, ...]]:
    """The parameters, with control points no closer than two voxels along any axis of the fixed image.

    Closer ones follow noise: on slices of 6 mm, control points every 4 mm gave a shear of 0.3 where there was none.
    """
    if SPACING not in parameters:
        return parameters
    given = np.array([float(v) for v in parameters[SPACING]])
    asked = np.broadcast_to(given, (3,)) if given.size in (1, 3) else np.full(3, given[0])
    spacing = np.maximum(asked, _LEAST_VOXELS * grid.spacing_mm)
    if np.all(spacing <= asked + 1e-9):
        return parameters
    used = " x ".join(f"{s:.3g}" for s in spacing)
    _log.warning(
        "The unloaded image (%s) is too coarse for control points every %g mm; a spacing of %s mm is used.",
        grid,
        given[0],
        used,
    )
    return parameters | {SPACING: tuple(f"{s:.6g}" for s in spacing)}


def _stage_methods(stage: Mapping[str, Any]) -> str:
    try:
        parameters = parse_parameters(str(stage.get("text", "")))
    except ParameterError:
        return f"parameters '{stage.get('name')}'"

    def value(name: str) -> str:
        """Values of a parameter, one for all where they are equal."""
        values = parameters.get(name, ())
        return ", ".join(dict.fromkeys(values) if len(set(values)) == 1 else values) or "elastix' default"

    return (
        f"parameters '{stage.get('name')}', metric {value('Metric')}, {value('Transform')} with control points every "
        f"{value(SPACING)} mm (or two voxels, if that is larger), {value('NumberOfResolutions')} resolutions, "
        f"{value('Optimizer')} with {value('MaximumNumberOfIterations')} iterations of "
        f"{value('NumberOfSpatialSamples')} samples"
    )
