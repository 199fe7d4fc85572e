"""From a pair of images to the deformation of the tissue: correct shading, align on the bone, register non-rigidly.

The rigid motion of the bone is put into the loaded image's header, which moves the image without resampling
it. The B-spline found then maps the reference configuration straight to the bone-aligned loaded one, so its
displacement is that of the tissue relative to its bone; T(X) = R (X + u(X)) + t is the whole motion.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from dvc.arrays import FloatArray
from dvc.deformation.bordered_spline import Spline
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Composed, Deformation, RigidMotion, Within
from dvc.errors import InputError, ParameterError
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.shading import without_shading
from dvc.images.tissue import tissue_mask
from dvc.registration.align import Alignment, AlignOn, align, not_aligned, refuse_turned_contrast
from dvc.registration.elastix.presets import Preset, preset_or_file
from dvc.registration.engines import by_elastix, by_gauss_newton
from dvc.registration.gauss_newton.fit import Choice, GaussNewton
from dvc.registration.gauss_newton.with_borders import USUAL_SKIN, AtBorders
from dvc.worker import Worker

Progress = Callable[[str, float], None]
_Scan = TypeVar("_Scan", Image, Mask, LabelMap)

GAUSS_NEWTON, AT_BORDERS = "gauss-newton", "gauss-newton-borders"
"""Names of our own engine, without and with borders of tissues, where elastix has presets."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How to register.

    Attributes
    ----------
    presets : tuple of Preset
        Non-rigid stages of elastix, one after the other; each starts from the coefficients of the one before.
    align_on : {"bone", "image", "none"}
        What is aligned rigidly first.
    seed : int
        Seed of every random number.
    threads : int
        Threads of each worker. What our own engine finds, the bone's alignment and the correction of shading are
        equal bit for bit on any number of threads; what elastix finds, on equal numbers.
    gauss_newton : GaussNewton, optional
        Parameters of our own engine, which then takes the place of elastix and the presets.
    borders : AtBorders, optional
        Our own engine then lets strain jump at the borders of the tissues of a label map.

    Raises
    ------
    ParameterError
        If borders are asked of elastix.
    """

    presets: tuple[Preset, ...] = ()
    align_on: AlignOn = "bone"
    seed: int = 1
    threads: int = 1
    gauss_newton: GaussNewton | None = None
    borders: AtBorders | None = None

    def __post_init__(self) -> None:
        if self.borders is not None and self.gauss_newton is None:
            raise ParameterError(
                f"Borders of tissues are for the engine {GAUSS_NEWTON}; elastix finds one smooth spline. Leave out "
                "--borders, or the engine, preset or parameter files of elastix."
            )

    @property
    def engine(self) -> str:
        """Name of what finds the non-rigid part."""
        return "elastix" if self.gauss_newton is None else GAUSS_NEWTON

    @property
    def name(self) -> str:
        """What an error model is known by: one of the two names of our own engine, or the last preset of elastix."""
        if self.gauss_newton is None:
            return self.presets[-1].name
        return GAUSS_NEWTON if self.borders is None else AT_BORDERS

    @property
    def needs_one_contrast(self) -> bool:
        """Whether what is brighter than its neighbours must be so in both images; not for mutual information."""
        metrics = [metric for preset in self.presets for metric in preset.parameters.get("Metric", ())]
        return not any("MutualInformation" in metric for metric in metrics)

    @property
    def text(self) -> str:
        """All parameters of the non-rigid part, as written."""
        if self.gauss_newton is None:
            return "\n".join(p.text for p in self.presets)
        return self.gauss_newton.text if self.borders is None else self.borders.text(self.gauss_newton)

    def of_repeat(self) -> Settings:
        """For a repeat scan: a weight chosen for it alone would smooth away the noise that it is to show."""
        own = self.gauss_newton
        if own is None:
            return self
        borders = None if self.borders is None else replace(self.borders, skin=self.borders.skin or USUAL_SKIN)
        fixed = replace(own, bending=own.weights.bending, volume=own.weights.volume)
        return replace(self, gauss_newton=fixed, borders=borders)

    @classmethod
    def of(cls, name: str = GAUSS_NEWTON, **others: object) -> Settings:
        """Settings by name: our own engine's, a preset of elastix, or the path of a parameter file (.txt)."""
        if name in {GAUSS_NEWTON, AT_BORDERS}:
            own = cls(gauss_newton=GaussNewton(), borders=AtBorders() if name == AT_BORDERS else None)
            return replace(own, **others)  # type: ignore[arg-type]
        return replace(cls(presets=(preset_or_file(name),)), **others)  # type: ignore[arg-type]


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
    bspline : BSpline or BorderedSpline
        Displacement of tissue relative to its bone, reference configuration, LPS mm; with borders the second.
    settings : Settings
    seconds : float
        Wall time.
    choice : Choice or None
        How strongly Gauss-Newton smoothed, and why; None for elastix.
    """

    reference: Image
    loaded: Image
    tissue: Mask
    bone: Mask | None
    alignment: Alignment
    bspline: Spline
    settings: Settings
    seconds: float
    choice: Choice | None = None

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
    labels: LabelMap | None = None,
    settings: Settings | None = None,
    start: Deformation | None = None,
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
    labels : LabelMap, optional
        Tissues on the reference grid; needed, and used, where ``settings.borders`` is given.
    settings : Settings, optional
        The engine gauss-newton, seed 1, one thread by default.
    start : Deformation, optional
        Result of another load (its ``bspline``) to start from: the first guess, which the registration then corrects
        against these two images, so no error is carried on. elastix starts from a `BSpline` alone.
    worker : Worker, optional
        Process to compute in; a new one by default.
    progress : callable, optional
        ``progress(stage, fraction)``, about twice a second.

    Returns
    -------
    Registration

    Raises
    ------
    InputError
        If the two images are the same, a mask or the labels are missing, empty or on another grid, or elastix is to
        start from something else than one B-spline.
    RegistrationError
        If the bone cannot be found in the loaded image, if the contrast of the two images is turned round and is not
        to be followed by mutual information, or if elastix fails; with elastix' reason.
    WorkerError
        If the process dies.
    """
    began = time.monotonic()
    chosen = settings or Settings.of()
    if not chosen.presets and chosen.gauss_newton is None:
        raise ParameterError("No registration stage given; name a preset or parameter files.")
    _refuse_other_spacing(chosen.presets)
    tell = progress or (lambda _stage, _fraction: None)
    refuse_one_image_twice([("The unloaded image", reference), ("the loaded one", loaded)])
    body = tissue if tissue is not None else tissue_mask(reference)
    _check_masks(reference, body, bone, chosen.align_on)
    if chosen.borders is not None:
        _check_labels(reference, labels)
    if chosen.gauss_newton is None and start is not None and not isinstance(start, BSpline):
        raise InputError(
            f"elastix starts from one B-spline, and a {type(start).__name__} is given: start from a result without "
            f"borders, or register with {GAUSS_NEWTON}."
        )
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
        # elastix draws samples from a box along the world's axes, which of an oblique image holds a part or nothing:
        # what follows is done in a world whose axes are those of the unloaded image.
        turn = Rotation.from_matrix(fixed.grid.direction).as_matrix()
        fixed, moving, inside = _turned(fixed, turn.T), _turned(moving, turn.T), _turned(inside, turn.T)
        on = None if on is None else _turned(on, turn.T)
        begun_at = None if start is None else _turned_start(start, turn.T)
        alignment = _align(fixed, moving, inside, on, chosen, runner)
        if chosen.align_on == "none" and chosen.needs_one_contrast:  # a rigid alignment refuses it by itself
            refuse_turned_contrast(fixed, moving, inside, alignment.motion)
        tell("aligning", 1.0)
        bspline: Spline | None = None
        choice = None
        if chosen.gauss_newton is not None:
            rigid = on if chosen.align_on == "bone" else None
            borders = None
            if chosen.borders is not None and labels is not None:
                borders = chosen.borders, _turned(labels.toward_lps(), turn.T)
            bspline, choice = by_gauss_newton(
                fixed, moving, inside, rigid, alignment, chosen.gauss_newton, begun_at, runner,
                lambda fraction: tell("registering", fraction), borders,
            )  # fmt: skip
        last = begun_at if isinstance(begun_at, BSpline) else None
        for number, preset in enumerate(chosen.presets if chosen.gauss_newton is None else ()):
            stage = "registering" if len(chosen.presets) == 1 else f"registering, stage {number + 1}"
            bspline = last = by_elastix(
                fixed,
                moving,
                inside,
                alignment,
                preset,
                _seeds(chosen)[number + 1],
                last,
                runner,
                lambda fraction, stage=stage: tell(stage, fraction),  # type: ignore[misc]
            )
    finally:
        if own:
            runner.close()
    assert bspline is not None
    alignment, bspline = alignment.turned(turn), bspline.turned(turn)
    return Registration(reference, loaded, body, bone, alignment, bspline, chosen, time.monotonic() - began, choice)


def _turned(scan: _Scan, rotation: FloatArray) -> _Scan:
    return replace(scan, grid=scan.grid.moved_by(rotation, np.zeros(3)))


def refuse_one_image_twice(images: Sequence[tuple[str, Image]]) -> None:
    """Refuse scans of which two are the same image, told by the names given with them.

    Raises
    ------
    InputError
        Naming the two.
    """
    for (one, image), (other, second) in combinations(images, 2):
        if image.grid.same_as(second.grid) and np.array_equal(image.values, second.values, equal_nan=True):
            raise InputError(
                f"{one} and {other} are the same image: every voxel is equal. Check the file names; two scans, even "
                "of a resting foot, differ by their noise."
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


def _check_labels(reference: Image, labels: LabelMap | None) -> None:
    if labels is None:
        raise InputError("Borders of tissues are asked for, and no label map is given: give --labels, too.")
    if not labels.grid.same_as(reference.grid):
        raise InputError("The label map is not on the unloaded image's grid; bring it there (fit_mask).")
    if not labels.labels.any():
        raise InputError("The label map is empty.")


def _turned_start(start: Deformation, rotation: FloatArray) -> Deformation:
    """The start in a world that is turned about its origin."""
    if isinstance(start, BSpline):
        return start.turned(rotation)
    there = RigidMotion(rotation, np.zeros(3))
    return Composed([there.inverse(), start, there])


def _align(
    reference: Image, loaded: Image, body: Mask, bone: Mask | None, settings: Settings, worker: Worker
) -> Alignment:
    if settings.align_on == "none":
        return not_aligned(reference, loaded, body)
    mask = bone if settings.align_on == "bone" and bone is not None else body
    return worker.run("aligning the bone", align, reference, loaded, mask, settings.align_on, _seeds(settings)[0])


def _seeds(settings: Settings) -> list[int]:
    """Independent seeds: of the rigid alignment, then of each non-rigid stage."""
    drawn = np.random.SeedSequence(settings.seed).generate_state(1 + len(settings.presets))
    return [int(s) % 2**30 + 1 for s in drawn]


def _refuse_other_spacing(presets: tuple[Preset, ...]) -> None:
    """Stages add their coefficients up, so their control points must be the same."""
    name = "FinalGridSpacingInPhysicalUnits"
    found = {p.parameters.get(name, p.parameters.get("FinalGridSpacingInVoxels", ("default",))) for p in presets}
    if len(found) > 1:
        raise ParameterError(
            f"The stages end with different spacings of control points: {sorted(map(' '.join, found))}. Each stage "
            f"starts from the coefficients of the one before, so {name} must be the same in all."
        )
