"""From a pair of images to the deformation of the tissue: bias field, alignment on the bone, registration.

The rigid motion of the bone is put into the loaded image's header, which moves the image without resampling it. The
displacement u then maps the reference configuration straight to the bone-aligned loaded one, so it is that of the
tissue relative to its bone; T(X) = R (X + u(X)) + t is the whole motion.
"""

import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Self, TypeVar, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from dvc.arguments import check, checked
from dvc.arrays import FloatArray
from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import InterfaceSpline
from dvc.deformation.protocol import Composed, Deformation, RigidMotion, Within
from dvc.errors import InputError, ParameterError
from dvc.images.bias_field import without_bias_field
from dvc.images.image import Image, LabelMap, Mask, reordered_to_lps
from dvc.images.noise import Noise, noise_of
from dvc.images.tissue import bright_voxels, tissue_mask
from dvc.memory import hand_memory_back
from dvc.registration.align import Alignment, AlignOn, align, not_aligned, refuse_turned_contrast
from dvc.registration.bone_mask import mask_doubt
from dvc.registration.engine import AlignedPair, Displacement, Engine, Progress, Regularisation
from dvc.registration.engines import default_engine, engine_named
from dvc.threads import most_threads, usable_cores
from dvc.worker import Worker

_log = logging.getLogger("dvc.registration")

_PREPARED = 0.2  # of the alignment: images are without bias field, and the worker gets them
_MOSTLY_BONE = 0.8  # of the body: a shank or a knee is less than half bone

_Scan = TypeVar("_Scan", Image, Mask, LabelMap)


@dataclass(frozen=True, slots=True)
class Settings:
    """How to register.

    Attributes
    ----------
    engine : Engine
        Engine of the non-rigid registration, with its parameters.
    align_on : {"bone", "image", "none"}
        What the rigid alignment before the registration uses.
    seed : int
        Seed of every random number.
    threads : int
        Threads of each worker. The Gauss-Newton engine, the rigid alignment and the bias field correction give the same
        result bit for bit on any number of threads; elastix only on equal numbers of threads.

    Raises
    ------
    ParameterError
        For an engine by its name (see `Settings.of`), another alignment, less than one thread, or far too many.
    """

    engine: Engine
    align_on: AlignOn = "bone"
    seed: int = 1
    threads: int = 1

    def __post_init__(self) -> None:
        if not hasattr(self.engine, "of_repeat"):
            raise ParameterError(f"`engine` must be an Engine; for an engine by name use Settings.of({self.engine!r}).")
        check("threads", self.threads, int)
        if self.align_on not in get_args(AlignOn):
            raise ParameterError(f"`align_on` must be {' or '.join(get_args(AlignOn))}; got {self.align_on!r}.")
        if not 1 <= self.threads <= most_threads():
            raise ParameterError(
                f"`threads` must be 1 to {most_threads()}; got {self.threads}. This machine has {usable_cores()} cores."
            )

    def of_repeat(self) -> Self:
        """The settings for a repeat scan, which must not be smoothed more than a loaded image."""
        return replace(self, engine=self.engine.of_repeat())

    @classmethod
    def of(cls, name: str, **others: Any) -> Self:
        """Settings with an engine by its name, as in `dvc.registration.engines.engine_named`."""
        return cls(engine_named(name), **others)


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
        Aligned on, on the same grid.
    alignment : Alignment
        The bone's rigid motion, reference to loaded.
    displacement : Displacement
        Of tissue relative to its bone, reference configuration, LPS mm.
    settings : Settings
        As used: ``settings.engine`` is the engine that was used.
    seconds : float
        Wall time.
    noise : (Noise, Noise or None)
        Of the reference and of the loaded image (`dvc.images.noise.noise_of`).
    choice : Regularisation
        The regularisation weights that the engine used, and why.
    unlike_study : str
        Why the engine's error model does not apply to this pair; empty where it does.
    bone_doubt : str
        Why the bone mask may not lie on the bone (`dvc.registration.bone_mask`); empty where nothing tells.
    """

    reference: Image
    loaded: Image
    tissue: Mask
    bone: Mask | None
    alignment: Alignment
    displacement: Displacement
    settings: Settings
    seconds: float
    noise: tuple[Noise, Noise | None]
    choice: Regularisation = field(default_factory=Regularisation)
    unlike_study: str = ""
    bone_doubt: str = ""

    @property
    def deformation(self) -> Deformation:
        """Displacement of tissue relative to its bone; defined in the tissue (and one voxel around it)."""
        return Within(self.displacement, self.tissue)

    @property
    def bone_used(self) -> Mask | None:
        """Bone in the tissue, on the reference grid, up to the surface that the engine placed; None without one."""
        used = self.displacement.bone if isinstance(self.displacement, InterfaceSpline) else None
        if used is None or self.bone is None or not self.settings.engine.needs_bone:
            return None
        inside, grid = np.zeros_like(self.bone.inside), self.bone.grid
        start = np.rint(grid.toward_lps().indices_of(used.grid.origin_mm)).astype(int)
        box = tuple(slice(at, at + n) for at, n in zip(start, used.grid.shape, strict=True))
        reordered_to_lps(grid, inside)[box] = used.inside  # of a part of the image
        return Mask(grid, inside & self.tissue.inside)

    @property
    def total(self) -> Deformation:
        """The whole motion, bone included: reference points to points of the loaded scan as acquired."""
        return Composed([self.displacement, self.alignment.motion])


@checked
def register(
    reference: Image, loaded: Image, *, bone: Mask | None = None, tissue: Mask | None = None,
    labels: LabelMap | None = None, settings: Settings | None = None, start: Deformation | None = None,
    worker: Worker | None = None, progress: Progress | None = None,
) -> Registration:  # fmt: skip
    """Register a loaded image to the unloaded one.

    Parameters
    ----------
    reference, loaded, bone, tissue, labels, settings, worker, progress
        As in `dvc.measure`. Only an engine with strain discontinuities at tissue interfaces uses labels, and needs
        them.
    start : Deformation, optional
        First guess, such as the ``displacement`` of another load. It is then fitted to these two images, so its errors
        do not accumulate. elastix can start only from a `BSpline`.

    Returns
    -------
    Registration
        The ``alignment`` of the bone and the ``deformation`` of tissue relative to it, reference configuration, LPS mm.

    Raises
    ------
    InputError
        If the two images are the same, a mask or the labels are missing, empty or on another grid, or the engine
        cannot begin from ``start``.
    RegistrationError
        If the bone cannot be found in the loaded image, if the contrast of the two images is inverted and the engine
        cannot follow that, or if the engine fails.
    WorkerError
        If the process dies.
    """
    began = time.monotonic()
    chosen = settings or Settings(default_engine(labelled=labels is not None, on_bone=True))
    engine, tell = chosen.engine, progress or (lambda _stage, _fraction: None)
    refuse_one_image_twice([("The unloaded image", reference), ("the loaded one", loaded)])
    body = tissue if tissue is not None else tissue_mask(reference)
    tissues = labels if engine.needs_labels else None
    _check(reference, body, bone, tissues, chosen)
    if start is not None:
        engine.check_start(start)
    own = Worker(chosen.threads) if worker is None else nullcontext(worker)
    with own as runner, ThreadPoolExecutor(1) as beside:
        tell("aligning", 0.0)
        rigid = bone if chosen.align_on == "bone" else None
        fixed, moving, within, rigid, tissues, turn = _upright(reference, loaded, body, rigid, tissues)
        tell("aligning", _PREPARED)
        # Only now: it is done while the worker aligns, and has not kept it waiting for its images.
        beside.submit(engine.prepare)
        noise = beside.submit(noise_of, reference, loaded, body)
        doubt = beside.submit(mask_doubt, reference, bone, body) if bone and chosen.align_on == "bone" else None
        alignment = _alignment(fixed, moving, within, rigid, chosen, runner)
        runner.beforehand(engine.prepare_beside)
        pair = AlignedPair.of(fixed, moving, alignment.motion, within, rigid, tissues)
        tell("aligning", 1.0)
        of_noise = noise.result()  # known before the alignment, as a rule
        if doubted := doubt.result() if doubt else "":
            _log.warning(doubted)
        guess = start
        if isinstance(start, BSpline):  # and remains one
            guess = start.turned(turn.T)
        elif start is not None:
            there = RigidMotion(turn.T, np.zeros(3))
            guess = Composed([there.inverse(), start, there])
        beside.submit(hand_memory_back)  # the worker takes its largest amount now
        found = engine.find(pair, start=guess, seeds=_seeds(chosen)[1:], worker=runner, progress=tell)
    return Registration(
        reference, loaded, body, bone, alignment.turned(turn), found.displacement.turned(turn),
        replace(chosen, engine=found.engine or engine), time.monotonic() - began, of_noise, found.choice,
        found.unlike_study, doubted,
    )  # fmt: skip


def _upright(
    reference: Image, loaded: Image, body: Mask, bone: Mask | None, labels: LabelMap | None
) -> tuple[Image, Image, Mask, Mask | None, LabelMap | None, FloatArray]:
    """The images without bias field, and the masks, in a world whose axes are the unloaded image's; and its rotation.

    elastix draws samples from a box along the world's axes, which of an oblique image holds a part or nothing.
    """
    # Axes toward L, P, S: a scan stored in another orientation then gives the same result.
    upright = reference.toward_lps()
    turn: FloatArray = Rotation.from_matrix(upright.grid.direction).as_matrix()

    def turned(scan: _Scan) -> _Scan:
        return replace(scan, grid=scan.grid.moved_by(turn.T, np.zeros(3)))

    scans = (reference, upright), (loaded, loaded.toward_lps())
    bright = (reordered_to_lps(scan.grid, bright_voxels(scan)) for scan, _ in scans)
    fixed, moving = (turned(without_bias_field(scan, where)) for (_, scan), where in zip(scans, bright, strict=True))
    body, labels = turned(body.toward_lps()), labels and turned(labels.toward_lps())
    return fixed, moving, body, bone and turned(bone.toward_lps()), labels, turn


def _alignment(
    fixed: Image, moving: Image, body: Mask, bone: Mask | None, settings: Settings, worker: Worker
) -> Alignment:
    """How the bone, or all of the image, moved; or no motion."""
    if (on := settings.align_on) != "none":
        return worker.run("aligning the bone", align, fixed, moving, bone or body, on, _seeds(settings)[0])
    alignment = not_aligned(fixed, moving, body)
    if settings.engine.needs_one_contrast:  # a rigid alignment refuses it by itself
        refuse_turned_contrast(fixed, moving, body, alignment.motion)
    return alignment


def refuse_one_image_twice(images: Sequence[tuple[str, Image]]) -> None:
    """Refuse scans of which two are the same image, by an InputError with the names given with them."""
    for (one, image), (other, second) in combinations(images, 2):
        if image.grid.same_as(second.grid) and np.array_equal(image.values, second.values, equal_nan=True):
            raise InputError(
                f"{one} and {other} are the same image: all voxels are equal. Check the file names. Two scans always "
                "differ by their noise, even without load."
            )


def _check(reference: Image, body: Mask, bone: Mask | None, labels: LabelMap | None, settings: Settings) -> None:
    if settings.align_on == "bone" and bone is None:
        raise InputError(
            "Alignment on bone needs a bone mask on the unloaded image: bone (--bone on the command line). Without a "
            "bone, use Settings(dvc.GaussNewton(), align_on='image') or 'none' (--align)."
        )
    if settings.engine.needs_labels and labels is None:
        raise InputError("Strain discontinuities at tissue interfaces need a label map: labels (--labels).")
    if settings.engine.needs_bone and settings.align_on != "bone":
        raise InputError(
            "GaussNewtonAtBone (--borders) needs images aligned on the bone: align bone (--align bone). Otherwise use "
            "the engine GaussNewton (--no-borders)."
        )
    for name, given in (("tissue mask", body), ("bone mask", bone), ("label map", labels)):
        if given is None:
            continue
        if not given.grid.same_as(reference.grid):
            raise InputError(f"The {name} is not on the grid of the unloaded image; resample it with fit_mask.")
        if not (given.labels if isinstance(given, LabelMap) else given.inside).any():
            raise InputError(f"The {name} is empty: all voxels are 0. Choose another file.")
    if bone is not None and settings.align_on == "bone" and not (bone.inside & body.inside).any():
        raise InputError(
            "The bone mask lies outside the body. Check that bone (--bone), and the tissue mask if one was given "
            "(--tissue), are of this image."
        )
    if bone is not None and (share := float(np.mean(bone.inside[body.inside]))) > _MOSTLY_BONE:
        raise InputError(
            f"The bone mask covers {100 * share:.0f} % of the body, so there is no soft tissue to measure. Check that "
            "bone (--bone) is the mask of the bone, and not that of the body or of the whole image."
        )


def _seeds(settings: Settings) -> list[int]:
    """Independent seeds: of the rigid alignment, then those of the engine."""
    drawn = np.random.SeedSequence(settings.seed).generate_state(1 + settings.engine.seeds)
    return [int(s) % 2**30 + 1 for s in drawn]
