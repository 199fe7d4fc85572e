"""How uncertain the inputs of the models of a study are: its table [uncertainty]."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, field_validator

from mrstrain.options.model import Flag, NotNegative, Options

LEAST_RATIO, MOST_RATIO = 1.2, 2.5


def _different(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    if len(set(paths)) < len(paths):
        raise ValueError("each folder may occur only once")
    return paths


class Uncertainty(Options):
    """Standard uncertainty of each input of the models; 0, the default, takes the input as exact."""

    mesh: NotNegative = 0.0
    """Solve each model on a coarser mesh too, whose edges are longer by this factor, such as 1.4, to estimate the error
    of the mesh. All variants are then solved on the coarser mesh."""
    force: NotNegative = 0.0
    """Relative standard uncertainty of the plate's forces."""
    force_n: NotNegative = 0.0
    """Standard uncertainty of the plate's forces, N; combined with ``force`` as the root of the sum of squares."""
    direction_deg: NotNegative = 0.0
    """Standard uncertainty of the plate's normal, in each of the two directions of tilt, degrees."""
    tape: NotNegative = 0.0
    """Standard uncertainty of how firmly the skin sticks to the plate, as a fraction of the difference between skin
    that sticks and skin that slides without friction. It applies to loads without shear."""
    poisson: NotNegative = 0.0
    """Relative standard uncertainty of 0.5 - nu of every material."""
    stiffness: dict[str, NotNegative] = Field(default_factory=dict)
    """Relative standard uncertainty of the stiffness of a tissue, by the name of the tissue."""
    labels_voxels: NotNegative = 0.0
    """Standard uncertainty of the position of the bone's boundary and of the inner surface of the skin, in voxels of
    the label map that is meshed. If `label` made this label map, the boundaries of all soft tissues are uncertain, each
    by the larger of this value and the one that follows from the probability of the tissue."""
    variants: Annotated[tuple[Path, ...], AfterValidator(_different)] = ()
    """Folders with further variants of models, each with a ``variant.toml``: of other codes, or from `converge`."""
    quick: Flag = False
    """Skip the variants."""

    @field_validator("mesh")
    @classmethod
    def _coarser(cls, ratio: float) -> float:
        if ratio and not LEAST_RATIO <= ratio <= MOST_RATIO:
            raise ValueError(
                f"the edges of the coarser mesh must be {LEAST_RATIO:g} to {MOST_RATIO:g} times as long, or 0 for none"
            )
        return ratio

    @property
    def solves(self) -> bool:
        """Whether there are variants to solve."""
        given = (self.mesh, self.force, self.force_n, self.direction_deg, self.tape, self.poisson, self.labels_voxels)
        return not self.quick and bool(any(given) or any(self.stiffness.values()))

    @property
    def solutions(self) -> tuple[int, int]:
        """About how many variants of a material set are solved as a whole, and how many from a converged state."""
        whole = bool(self.mesh) + 2 * bool(self.direction_deg) + bool(self.tape)
        moved = 2 * bool(self.labels_voxels)
        changed = sum(map(bool, (self.force or self.force_n, self.poisson, *self.stiffness.values())))
        return whole, changed + moved
