"""The non-rigid part: of two images whose bone is aligned, an engine finds the displacement between them."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from dvc.deformation.bordered_spline import Spline
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Deformation
from dvc.errors import ParameterError, RegistrationError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.images.resample import fill_missing
from dvc.images.tissue import widened
from dvc.io.transforms.read import bspline_from_elastix
from dvc.io.transforms.write import write_elastix_transform
from dvc.registration.align import Alignment
from dvc.registration.elastix import run as elastix
from dvc.registration.elastix.presets import Preset
from dvc.registration.gauss_newton.fit import Choice, GaussNewton, fit
from dvc.registration.gauss_newton.with_borders import AtBorders, fit_with_borders
from dvc.worker import Worker

_log = logging.getLogger("dvc.registration.engines")

_MASK_MARGIN_MM = 3.0
_CROP_VOXELS = 4
_LEAST_VOXELS = 2.0


def by_elastix(
    reference: Image,
    loaded: Image,
    body: Mask,
    alignment: Alignment,
    preset: Preset,
    seed: int,
    start: BSpline | None,
    worker: Worker,
    tell: Callable[[float], None],
) -> BSpline:
    """Displacement by one elastix stage, added to that of the stage or load before it, ``start``."""
    if "BSplineTransform" not in preset.transform:
        raise ParameterError(
            f'{preset.name}: (Transform "{preset.transform}") is no B-spline; the non-rigid stage needs '
            '"RecursiveBSplineTransform" or "BSplineTransform".'
        )
    moving, moving_mask = without_gaps(_moved_back(loaded, alignment))
    whole, box = _compared(reference, body)
    mask = _cut(whole, box)
    fixed = Image(mask.grid, fill_missing(reference).values[box])
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        initial = None
        if start is not None:
            initial = str(write_elastix_transform(Path(folder), start, None, fixed.grid)[0])
        total = preset.iterations
        run = preset.complete(seed=seed, combine="Add" if start is not None else "Compose")
        parameters = _resolvable(run, fixed.grid)
        found = worker.run(
            f"registering with {preset.name}",
            elastix.register,
            fixed,
            moving,
            parameters,
            mask,
            moving_mask,
            initial,
            folder,
            watch=lambda: tell(min(1.0, elastix.finished_iterations(Path(folder)) / total)),
        )
    tell(1.0)
    bspline = bspline_from_elastix(found.transform)
    if not np.isfinite(bspline.coefficients_mm).all():
        raise RegistrationError(f"{preset.name}: elastix' optimiser diverged (coefficients are not finite).")
    return bspline.plus(start) if start is not None else bspline


def by_gauss_newton(
    reference: Image,
    loaded: Image,
    body: Mask,
    bone: Mask | None,
    alignment: Alignment,
    options: GaussNewton,
    start: Deformation | None,
    worker: Worker,
    tell: Callable[[float], None],
    borders: tuple[AtBorders, LabelMap] | None = None,
) -> tuple[Spline, Choice]:
    """Displacement by our own engine, begun at ``start`` if there is one; ``bone`` stays rigid.

    With ``borders``, the tissues on the reference grid, strain may jump where they meet.
    """
    whole, box = _compared(reference, body)
    mask = _cut(whole, box)
    given = (
        Image(mask.grid, reference.values[box]),
        _moved_back(loaded, alignment),
        mask,
        _cut(body, box),
        None if bone is None else _cut(bone, box),
    )
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        done = Path(folder) / "share done"
        done.write_text("0")

        def run(engine: Callable[..., tuple[Spline, Choice]], *more: object) -> tuple[Spline, Choice]:
            return worker.run(
                "registering with gauss-newton", engine, *given, *more, start, partial(_note, str(done)),
                watch=lambda: tell(float(done.read_text() or 0)),
            )  # fmt: skip

        if borders is None:
            found = run(fit, options)
        else:
            at_borders, labels = borders
            here = LabelMap(mask.grid, labels.labels[box], labels.names)
            found = run(fit_with_borders, here, options, at_borders)
    tell(1.0)
    return found


def _note(path: str, share: float) -> None:
    """Write the share that is done where the process that waits looks for it."""
    Path(path).write_text(f"{share:.3f}")


def without_gaps(image: Image) -> tuple[Image, Mask | None]:
    """The image with missing voxels filled in, and the mask of those that are known, where any is missing."""
    missing = image.missing
    return fill_missing(image), Mask(image.grid, ~missing) if missing.any() else None


def _moved_back(loaded: Image, alignment: Alignment) -> Image:
    """The loaded image with the bone's motion taken out, by its header alone."""
    back = alignment.motion.inverse()
    return Image(loaded.grid.moved_by(back.rotation, back.translation_mm), loaded.values)


def _compared(reference: Image, body: Mask) -> tuple[Mask, tuple[slice, slice, slice]]:
    """Voxels to compare, and their box with a few voxels around: control points in empty air cost time."""
    mask = Mask(reference.grid, widened(body, _MASK_MARGIN_MM).inside & ~reference.missing)
    return mask, mask.box(_CROP_VOXELS)


def _cut(mask: Mask, box: tuple[slice, slice, slice]) -> Mask:
    return Mask(mask.grid.part(box), mask.inside[box])


def _resolvable(parameters: dict[str, tuple[str, ...]], grid: Grid) -> dict[str, tuple[str, ...]]:
    """The parameters, with control points no closer than two voxels along any axis of the fixed image.

    Closer ones follow noise: on slices of 6 mm, control points every 4 mm gave a shear of 0.3 where there was none.
    """
    name = "FinalGridSpacingInPhysicalUnits"
    if name not in parameters:
        return parameters
    given = np.array([float(v) for v in parameters[name]])
    asked = np.broadcast_to(given, (3,)) if given.size in (1, 3) else np.full(3, given[0])
    spacing = np.maximum(asked, _LEAST_VOXELS * grid.spacing_mm)
    if np.all(spacing <= asked + 1e-9):
        return parameters
    told = " x ".join(f"{s:.3g}" for s in spacing)
    _log.warning(
        "The unloaded image, %s, is too coarse for control points every %g mm; %s mm are used.", grid, given[0], told
    )
    return parameters | {name: tuple(f"{s:.6g}" for s in spacing)}
