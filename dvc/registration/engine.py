"""What every registration engine is: it finds the displacement between two images whose bone is aligned.

An engine is a frozen dataclass of its parameters that subclasses `Engine` and lies in a file of its own. A new one
defines its name, its parameters and how it finds a displacement; for the rest there are defaults.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, Self

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
    """An image pair to be registered, with the rigid motion of the bone already removed.

    Attributes
    ----------
    fixed : Image
        Unloaded image, without its bias field. Voxels may be missing (NaN).
    moving : Image
        Loaded image, likewise. The bone's motion is removed by changing its grid, so nothing is resampled.
    compared : Mask
        Voxels of ``fixed`` to compare.
    body : Mask
        Tissue on the grid of ``fixed``, bone included.
    bone : Mask or None
        The rigid bone of the alignment, on the same grid. None if the images are not aligned on a bone.
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
    ) -> Self:
        """Take the bone's ``motion`` out of the moving image, and compare the body and 3 mm around it."""
        back = motion.inverse()
        compared = Mask(fixed.grid, widened(body, _MASK_MARGIN_MM).inside & ~fixed.missing)
        still = Image(moving.grid.moved_by(back.rotation, back.translation_mm), moving.values)
        return cls(fixed, still, compared, body, bone, labels)

    def cut(self) -> Self:
        """The pair on the box of the voxels compared and a few around it: control points in empty air cost time."""
        box = self.compared.box(_CROP_VOXELS)
        grid = self.fixed.grid.part(box)
        compared, body = (Mask(grid, mask.inside[box]) for mask in (self.compared, self.body))
        bone = self.bone and Mask(grid, self.bone.inside[box])
        labels = self.labels and LabelMap(grid, self.labels.labels[box], self.labels.names)
        return type(self)(Image(grid, self.fixed.values[box]), self.moving, compared, body, bone, labels)


class Displacement(Deformation, Protocol):
    """The displacement of tissue relative to its bone, LPS mm, reference configuration, as an engine finds it."""

    @property
    def spacing_mm(self) -> FloatArray:
        """Distance (3,) between its unknowns along their axes, mm: the control points of a spline, for instance.

        Nearer than that to the end of a scan it rests on a part of the image that is not there.
        """

    def turned(self, rotation: FloatArray) -> Self:
        """The same displacement of a body that is rotated about the world's origin."""


class Regularisation:
    """The regularisation weights of a pair, and why; this one is for an engine that chooses no weights by pair."""

    @property
    def in_bone(self) -> tuple[float, float] | None:
        """Displacement (rms, mm) and 95th percentile of the maximum shear in the bone before it was constrained."""
        return None

    @property
    def caution(self) -> str:
        """Why the result is to be used with care; empty where there is no reason."""
        return ""

    @property
    def caption(self) -> str:
        """The rule by which the weights were chosen, in words."""
        return ""

    def rows(self) -> list[tuple[str, float, str, str | float]]:
        """Each weight: what it penalises, its value, its unit, and "used" or what it left out, % above the least."""
        return []

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {}


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The result of an engine for one pair."""

    displacement: Displacement
    choice: Regularisation = field(default_factory=Regularisation)
    unlike_study: str = ""  # why the engine's error model does not hold for this pair; empty where it does
    engine: "Engine | None" = None  # that was used instead of the one asked for


@dataclass(frozen=True, slots=True)
class Cost:
    """Approximate cost of an engine, for each million voxels of the unloaded image where it says so."""

    seconds: float = 0.0  # on one core, whatever the size
    seconds_per_mvoxel: float = 1.7  # on one core
    phantom_seconds: float = 30.0  # on one core, to make, register and score one phantom of an accuracy study
    gib: float = 0.0  # memory beside that of alignment
    gib_per_mvoxel: float = 0.175
    bytes_per_voxel: float = 0.0  # of its results on disk, beside the maps


class Engine(Protocol):
    """An engine of the non-rigid registration, with its parameters."""

    family: ClassVar[str]
    """The name by which ``--engine`` and results know it."""
    needs_labels: ClassVar[bool] = False
    """Whether it needs a label map of the tissues."""
    needs_bone: ClassVar[bool] = False
    """Whether it needs an alignment on a bone."""
    sees_brightness: ClassVar[bool] = True
    """Whether an offset in brightness between the images misleads it; it does not mislead correlation."""
    starts_anywhere: ClassVar[bool] = True
    """Whether it can start from any displacement; otherwise only from its own results."""
    cost: ClassVar[Cost] = Cost()
    """Time, memory and disk space that it takes."""
    note: ClassVar[str] = ""
    """A remark on its results for the reader of a report; empty where none is needed."""

    @property
    def name(self) -> str:
        """The name by which an error model is known."""

    @property
    def may_be(self) -> tuple[str, ...]:
        """Names of the engines that may be used when it is asked for, its own first."""
        return (self.name,)

    @property
    def text(self) -> str:
        """Every parameter that affects the result; an error model is valid for one such text."""

    @property
    def needs_one_contrast(self) -> bool:
        """Whether the two images must have the same contrast."""
        return True

    @property
    def seeds(self) -> int:
        """Number of independent random seeds."""
        return 0

    @property
    def without_error_model(self) -> str:
        """Why there can be no error model for it; empty if there can be one."""
        return ""

    @property
    def unlike_its_error_model(self) -> str:
        """Why the error model of this name is not valid, if it was made with other parameters."""
        return other_parameters(self.name)

    def of_repeat(self) -> Self:
        """The engine for a repeat scan, which must not smooth more than for a loaded pair."""
        return self

    def keeping_volume(self) -> Self:
        """The engine for tissue that is known to be incompressible."""
        return self

    def check_start(self, start: Deformation) -> None:
        """InputError for an earlier result from which it cannot start."""
        return

    def prepare(self) -> None:
        """Prepare the first run on a machine (compilation); done in parallel with the rigid alignment."""
        return

    def prepare_beside(self) -> None:
        """Prepare a part of the same in the process of the alignment, once that is done."""
        return

    def record(self) -> dict[str, object]:
        """Its parameters as plain values, for provenance."""

    @classmethod
    def methods(cls, record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        """Methods text from the parameters of a provenance record; empty if another engine was used."""
        return ""

    def find(
        self, pair: AlignedPair, *, start: Deformation | None, seeds: Sequence[int], worker: Worker, progress: Progress
    ) -> Found:
        """Find the displacement that maps the fixed image onto the moving one.

        Parameters
        ----------
        start : Deformation or None
            First guess, u in mm LPS, accepted by `check_start`.
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


def other_parameters(name: str) -> str:
    """Why an error model does not hold for an engine of its name whose parameters are others."""
    return f"The error of {name} was measured with other parameters; measure yours with `mrstrain accuracy`."
