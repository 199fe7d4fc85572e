"""From a pair of images to the deformation of the tissue: correct shading, align on the bone, register non-rigidly.

The rigid motion of the bone is put into the loaded image's header, which moves the image without resampling
it. The B-spline found then maps the reference configuration straight to the bone-aligned loaded one, so its
displacement is that of the tissue relative to its bone; T(X) = R (X + u(X)) + t is the whole motion.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc import elastix
from dvc.align import Alignment, AlignOn, align, not_aligned
from dvc.bspline import BSpline
from dvc.deformation import Composed, Deformation, Within
from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.image import Grid, Image, Mask
from dvc.presets import Preset, load_preset
from dvc.resample import fill_missing
from dvc.shading import without_shading
from dvc.tissue import tissue_mask, widened
from dvc.transformfile import bspline_from_elastix
from dvc.transformwrite import write_elastix_transform
from dvc.worker import Worker

Progress = Callable[[str, float], None]

_log = logging.getLogger("dvc.registration")

_MASK_MARGIN_MM = 3.0
_CROP_VOXELS = 4
_LEAST_VOXELS = 2.0


@dataclass(frozen=True, slots=True)
class Settings:
    """How to register.

    Attributes
    ----------
    presets : tuple of Preset
        Non-rigid stages, one after the other; each starts from the coefficients of the one before.
    align_on : {"bone", "image", "none"}
        What is aligned rigidly first.
    seed : int
        Seed of every random number.
    threads : int
        Threads of each worker. Results are equal bit for bit on equal numbers of threads.
    """

    presets: tuple[Preset, ...] = ()
    align_on: AlignOn = "bone"
    seed: int = 1
    threads: int = 1

    @classmethod
    def of(cls, preset: str = "heel-mr", **others: object) -> Settings:
        """Settings with a named preset."""
        return replace(cls(presets=(load_preset(preset),)), **others)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A registered pair.

    Attributes
    ----------
    reference, loaded : Image
        As given.
    tissue : Mask
        Where the deformation is wanted, on the reference grid: soft tissue and bone.
    bone : Mask or None
    alignment : Alignment
        The bone's rigid motion, reference to loaded.
    bspline : BSpline
        Displacement of tissue relative to its bone, reference configuration, LPS mm.
    settings : Settings
    seconds : float
        Wall time.
    """

    reference: Image
    loaded: Image
    tissue: Mask
    bone: Mask | None
    alignment: Alignment
    bspline: BSpline
    settings: Settings
    seconds: float

    @property
    def deformation(self) -> Deformation:
        """Displacement of tissue relative to its bone; defined in the tissue (and one voxel around it)."""
        return Within(self.bspline, self.tissue)

    @property
    def total(self) -> Deformation:
        """The whole motion, bone included: reference points to points of the loaded scan as acquired."""
        return Composed([self.bspline, self.alignment.motion])


def register(
    reference: Image,
    loaded: Image,
    *,
    bone: Mask | None = None,
    tissue: Mask | None = None,
    settings: Settings | None = None,
    start: BSpline | None = None,
    worker: Worker | None = None,
    progress: Progress | None = None,
) -> Registration:
    """Register a loaded image to the unloaded one.

    Parameters
    ----------
    reference, loaded : Image
        Unloaded and loaded image, each in the frame of its own file (LPS mm).
    bone : Mask
        The bone to align on, on the reference grid; needed unless ``settings.align_on`` is not "bone".
    tissue : Mask, optional
        Body on the reference grid, bone included; found by a threshold where it is not given.
    settings : Settings, optional
        Preset heel-mr, seed 1, one thread by default.
    start : BSpline, optional
        Result of another load to start from: its coefficients are the first guess, which the registration
        then corrects against these two images, so no error is carried on.
    worker : Worker, optional
        Process to run elastix in; a new one by default.
    progress : callable, optional
        ``progress(stage, fraction)``, about twice a second.

    Returns
    -------
    Registration

    Raises
    ------
    InputError
        If the two images are the same, or a mask is missing or empty.
    RegistrationError
        If the bone cannot be found in the loaded image, or elastix fails; with elastix' reason.
    WorkerError
        If the process that runs elastix dies.
    """
    began = time.monotonic()
    chosen = settings or Settings.of()
    if not chosen.presets:
        raise ParameterError("No registration stage given; name a preset or parameter files.")
    _refuse_other_spacing(chosen.presets)
    tell = progress or (lambda _stage, _fraction: None)
    _refuse_same(reference, loaded)
    body = tissue if tissue is not None else tissue_mask(reference)
    _check_masks(reference, body, bone, chosen.align_on)
    own = worker is None
    runner = worker or Worker(chosen.threads)
    try:
        tell("aligning", 0.0)
        # Axes toward L, P, S: a scan stored in another orientation then gives the same result.
        fixed = runner.run("correcting the shading", without_shading, reference.toward_lps())
        tell("aligning", 0.2)
        moving = runner.run("correcting the shading", without_shading, loaded.toward_lps())
        tell("aligning", 0.4)
        inside = body.toward_lps()
        on = None if bone is None else bone.toward_lps()
        alignment = _align(fixed, moving, inside, on, chosen, runner)
        tell("aligning", 1.0)
        bspline = start
        for number, preset in enumerate(chosen.presets):
            stage = "registering" if len(chosen.presets) == 1 else f"registering, stage {number + 1}"
            bspline = _nonrigid(
                fixed,
                moving,
                inside,
                alignment,
                preset,
                _seeds(chosen)[number + 1],
                bspline,
                runner,
                lambda fraction, stage=stage: tell(stage, fraction),  # type: ignore[misc]
            )
    finally:
        if own:
            runner.close()
    assert bspline is not None
    return Registration(reference, loaded, body, bone, alignment, bspline, chosen, time.monotonic() - began)


def _refuse_same(reference: Image, loaded: Image) -> None:
    if reference.grid.same_as(loaded.grid) and np.array_equal(reference.values, loaded.values, equal_nan=True):
        raise InputError(
            "The loaded image is the unloaded one: every voxel is equal. Check the file names; two scans, even of "
            "a resting foot, differ by their noise."
        )


def _check_masks(reference: Image, body: Mask, bone: Mask | None, on: AlignOn) -> None:
    if on == "bone" and bone is None:
        raise InputError(
            "Aligning on the bone needs its mask on the unloaded image: give --bone, or --align image or none."
        )
    for name, mask in (("tissue", body), ("bone", bone)):
        if mask is None:
            continue
        if not mask.grid.same_as(reference.grid):
            raise InputError(f"The {name} mask is not on the unloaded image's grid; bring it there (fit_mask).")
        if not mask.inside.any():
            raise InputError(f"The {name} mask is empty.")


def _align(
    reference: Image, loaded: Image, body: Mask, bone: Mask | None, settings: Settings, worker: Worker
) -> Alignment:
    if settings.align_on == "none":
        return not_aligned(reference, loaded, body)
    mask = bone if settings.align_on == "bone" and bone is not None else body
    preset = load_preset("bone-rigid")

    def fit(fixed: Image, moving: Image, where: Mask, seed: int) -> dict[str, tuple[str, ...]]:
        known = Mask(where.grid, where.inside & ~fixed.missing)
        whole, seen = _without_gaps(moving)
        with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
            return worker.run(
                "aligning the bone",
                elastix.register,
                fill_missing(fixed),
                whole,
                preset.complete(seed=seed),
                known,
                seen,
                None,
                folder,
            ).transform

    seed = _seeds(settings)[0]
    return align(reference, loaded, mask, fit, on=settings.align_on, seed=seed)


def _seeds(settings: Settings) -> list[int]:
    """Independent seeds: of the rigid fits (two in a row are used), then of each non-rigid stage."""
    drawn = np.random.SeedSequence(settings.seed).generate_state(1 + len(settings.presets))
    return [int(s) % 2**30 + 1 for s in drawn]


def _without_gaps(image: Image) -> tuple[Image, Mask | None]:
    """The image with missing voxels filled in, and the mask of those that are known, where any is missing."""
    missing = image.missing
    return fill_missing(image), Mask(image.grid, ~missing) if missing.any() else None


def _cropped(image: Image, mask: Mask) -> tuple[Image, Mask]:
    """Both cut to the mask's box and a few voxels around: control points in empty air cost time and find nothing."""
    box = mask.box(_CROP_VOXELS)
    grid = image.grid.part(box)
    return Image(grid, image.values[box]), Mask(grid, mask.inside[box])


def _refuse_other_spacing(presets: tuple[Preset, ...]) -> None:
    """Stages add their coefficients up, so their control points must be the same."""
    name = "FinalGridSpacingInPhysicalUnits"
    found = {p.parameters.get(name, p.parameters.get("FinalGridSpacingInVoxels", ("default",))) for p in presets}
    if len(found) > 1:
        raise ParameterError(
            f"The stages end with different spacings of control points: {sorted(map(' '.join, found))}. Each stage "
            f"starts from the coefficients of the one before, so {name} must be the same in all."
        )


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


def _nonrigid(
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
    if "BSplineTransform" not in preset.transform:
        raise ParameterError(
            f'{preset.name}: (Transform "{preset.transform}") is no B-spline; the non-rigid stage needs '
            '"RecursiveBSplineTransform" or "BSplineTransform".'
        )
    fixed = fill_missing(reference)
    back = alignment.motion.inverse()
    moved_grid = loaded.grid.moved_by(back.rotation, back.translation_mm)
    moving, moving_mask = _without_gaps(Image(moved_grid, loaded.values))
    mask = Mask(reference.grid, widened(body, _MASK_MARGIN_MM).inside & ~reference.missing)
    fixed, mask = _cropped(fixed, mask)
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
