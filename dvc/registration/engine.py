"""What every registration engine is: it finds the displacement between two images whose bone is aligned.

An engine is a frozen dataclass of its parameters that subclasses `Engine` and lies in a file of its own. What most
engines have in common is the default here: a new one tells its name, its parameters and how it finds a displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

from dvc.arrays import FloatArray
from dvc.deformation.protocol import Deformation, RigidMotion
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.tissue import widened
from dvc.worker import Worker

Progress = Callable[[str, float], None]

_MASK_MARGIN_MM = 3.0
_CROP_VOXELS = 4


@dataclass(frozen=True, slots=True, eq=False)
class AlignedPair:
    """Two images between which a displacement is sought, the rigid motion of the bone already taken out.

    Attributes
    ----------
    fixed : Image
        Unloaded image, without its bias field. Voxels may be missing (NaN).
    moving : Image
        Loaded image, likewise; the bone's motion is taken out by its grid alone, so nothing is resampled.
    compared : Mask
        Voxels of ``fixed`` to compare.
    body : Mask
        Tissue on the grid of ``fixed``, bone included.
    bone : Mask or None
        The bone that the images are aligned on, on the same grid: it is rigid. None where they are not aligned on bone.
    labels : LabelMap or None
        Tissues on the same grid, for an engine that needs them.
    """

    fixed: Image
    moving: Image
    compared: Mask
    body: Mask
    bone: Mask | None = None
    labels: LabelMap | None = None

    @classmethod
    def of(
        cls, fixed: Image, moving: Image, motion: RigidMotion, body: Mask, bone: Mask | None, labels: LabelMap | None
    ) -> AlignedPair:
        """Take the bone's ``motion`` out of the moving image, and compare the body and 3 mm around it."""
        back = motion.inverse()
        compared = Mask(fixed.grid, widened(body, _MASK_MARGIN_MM).inside & ~fixed.missing)
        still = Image(moving.grid.moved_by(back.rotation, back.translation_mm), moving.values)
        return cls(fixed, still, compared, body, bone, labels)

    def cut(self) -> AlignedPair:
        """The pair on the box of the voxels compared and a few around it: control points in empty air cost time."""
        box = self.compared.box(_CROP_VOXELS)
        grid = self.fixed.grid.part(box)
        return AlignedPair(
            Image(grid, self.fixed.values[box]),
            self.moving,
            _cut(self.compared, box),
            _cut(self.body, box),
            None if self.bone is None else _cut(self.bone, box),
            None if self.labels is None else LabelMap(grid, self.labels.labels[box], self.labels.names),
        )


def _cut(mask: Mask, box: tuple[slice, slice, slice]) -> Mask:
    return Mask(mask.grid.part(box), mask.inside[box])


class Displacement(Deformation, Protocol):
    """What an engine finds: the displacement of tissue relative to its bone, LPS mm, reference configuration."""

    @property
    def spacing_mm(self) -> FloatArray:
        """Distance (3,) between its unknowns along their axes, mm: the control points of a spline, for instance.

        Nearer than that to the end of a scan it rests on a part of the image that is not there.
        """
        ...

    def turned(self, rotation: FloatArray) -> Displacement:
        """The same displacement of a body that is rotated about the world's origin."""
        ...


class Regularisation(Protocol):
    """How strongly an engine smoothed a pair, and why; for an engine that decides that for each pair."""

    @property
    def in_bone(self) -> tuple[float, float] | None:
        """Displacement (rms, mm) and 95th percentile of the maximal shear in the bone before it was constrained."""
        ...

    @property
    def caution(self) -> str:
        """Why the result is to be used with care; empty where there is no reason."""
        ...

    @property
    def caption(self) -> str:
        """The rule by which the weights were chosen, in words."""
        ...

    def rows(self) -> list[tuple[str, float, str, str | float]]:
        """Each weight: what it penalises, its value, its unit, and "used" or what it left out, % above the least."""
        ...

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What an engine found for one pair.

    Attributes
    ----------
    displacement : Displacement
    choice : Regularisation or None
        None where the engine decides nothing from the images.
    unlike_study : str
        Why an error model does not hold for this pair, though it is that of the engine; empty where it does.
    """

    displacement: Displacement
    choice: Regularisation | None = None
    unlike_study: str = ""


@dataclass(frozen=True, slots=True)
class Cost:
    """What an engine takes, about.

    Attributes
    ----------
    seconds_per_mvoxel : float
        On one core, for each million voxels of the unloaded image.
    phantom_seconds : float
        On one core, of one phantom of an accuracy study, which is made and scored as well.
    gib, gib_per_mvoxel : float
        Memory beside that of alignment, and for each million voxels.
    bytes_per_voxel : float
        Of its results on disk, beside the maps.
    """

    seconds_per_mvoxel: float = 7.0
    phantom_seconds: float = 30.0
    gib: float = 0.0
    gib_per_mvoxel: float = 0.175
    bytes_per_voxel: float = 0.0


class Engine(Protocol):
    """An engine with its parameters, which finds the non-rigid part of a registration."""

    @property
    def family(self) -> str:
        """What a user asks for by ``--engine``, and what results name the engine as."""
        ...

    @property
    def name(self) -> str:
        """What an error model is known by."""
        ...

    @property
    def text(self) -> str:
        """Every parameter that decides the result; an error model holds for one such text."""
        ...

    @property
    def needs_one_contrast(self) -> bool:
        """Whether what is brighter than its neighbours must be so in both images."""
        return True

    @property
    def needs_labels(self) -> bool:
        """Whether it needs a label map of the tissues."""
        return False

    @property
    def sees_brightness(self) -> bool:
        """Whether an even offset of brightness between the images misleads it, as it does not mislead correlation."""
        return True

    @property
    def starts_anywhere(self) -> bool:
        """Whether it can start from any displacement, whoever found it, or from results of its own alone."""
        return True

    @property
    def seeds(self) -> int:
        """How many independent seeds it draws random numbers from."""
        return 0

    @property
    def cost(self) -> Cost:
        """Time, memory and disk space that it takes."""
        return Cost()

    @property
    def note(self) -> str:
        """What a reader of a report must know of its results; empty where they are like any other's."""
        return ""

    @property
    def without_error_model(self) -> str:
        """Why no error model can be made for it; empty where one can."""
        return ""

    @property
    def unlike_its_error_model(self) -> str:
        """Why an error model of its name does not hold for it, where its parameters are not those of the model."""
        return other_parameters(self.name)

    def of_repeat(self) -> Self:
        """The engine for a repeat scan: it must smooth no more than it smooths a loaded pair."""
        return self

    def keeping_volume(self) -> Self:
        """The engine for tissue that is known to keep its volume."""
        return self

    def check_start(self, start: Deformation) -> None:
        """Refuse, by InputError, an earlier result from which it cannot start."""
        return

    def record(self) -> dict[str, object]:
        """Its parameters as plain values, for provenance."""
        ...

    @classmethod
    def methods(cls, record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        """How it registered, for a methods section, from a provenance record's parameters; empty if it did not."""
        return ""

    def find(
        self, pair: AlignedPair, *, start: Deformation | None, seeds: Sequence[int], worker: Worker, progress: Progress
    ) -> Found:
        """Find the displacement that carries the fixed image to the moving one.

        Parameters
        ----------
        pair : AlignedPair
        start : Deformation or None
            First guess, u in mm LPS, that `check_start` let pass.
        seeds : sequence of int
            As many as `seeds`.
        worker : Worker
            Process to compute in.
        progress : callable
            ``progress(stage, fraction)``.

        Raises
        ------
        InputError
            If the tissue has no contrast.
        RegistrationError
            If it fails or diverges.
        """
        ...


def other_parameters(name: str) -> str:
    """Why an error model does not hold for an engine of its name whose parameters are others."""
    return f"The error of {name} was measured with other parameters; `mrstrain accuracy` measures that of yours."
