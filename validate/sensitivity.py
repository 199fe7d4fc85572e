"""Input uncertainty of a model: how its strain changes with each input, and draws of all inputs together.

A variant is a further solution of a model with one input changed by a known number of standard uncertainties. The
maximum shear strain of a model in a draw is that of the model plus the sum of these changes, each times a standard
normal number (linear propagation).
"""

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from dvc import StrainField
from dvc.arguments import check_fields
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.nodal import OnMesh
from dvc.errors import InputError

MESH = "mesh"
"""Name of the input that stands for the discretisation: its part of the uncertainty is u_num."""

LABELS = "labels-"
"""Beginning of the names of inputs that stand for the boundary of a tissue in the label map, such as labels-bone."""

TAPE = "tape"
"""Name of the input that stands for how firmly the skin sticks to the plate, which loads with shear do not have."""

SHARED = ("force", "direction-along", "direction-across", TAPE)
"""Inputs that are the same for all models of a measurement, so that one draw of them holds for all; so are those that
begin with `LABELS`. Any other input, such as the mesh or Poisson's ratio, is that of one model alone."""


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """A solution of a model for one load, with one input changed.

    Attributes
    ----------
    input : str
        Name of the input, such as "force"; "mesh" for a solution on another mesh. See `SHARED`.
    steps : float
        Change of the input, in standard uncertainties of it; negative if it was decreased.
    read : callable
        Returns the deformation of the variant (reference configuration, LPS mm, relative to the bone).
    base : callable, optional
        Returns the solution with which the variant is compared; by default the model itself. Variants on a coarser mesh
        are compared with the solution on that mesh.

    Raises
    ------
    InputError
        If ``steps`` is zero or not finite.
    """

    input: str
    steps: float
    read: Callable[[], OnMesh]
    base: Callable[[], OnMesh] | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if not (np.isfinite(self.steps) and self.steps != 0.0):
            raise InputError(
                f"The variant of '{self.input}' needs the change of the input in standard uncertainties (steps), which "
                f"must not be 0; got {self.steps}."
            )


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Changes of a model's maximum shear strain in cells, and draws of them.

    Attributes
    ----------
    changes : mapping of input to (n,)
        Change by one standard uncertainty of each input.
    numbers : (draws, inputs)
        Standard normal numbers. The draw of an input is the same under all loads, and for all models if it is `SHARED`.
    """

    changes: Mapping[str, FloatArray]
    numbers: FloatArray
    _stacked: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_stacked", np.stack(list(self.changes.values())))

    @classmethod
    def of(cls, model: str, changes: Mapping[str, FloatArray], draws: int, seed: int) -> "Sensitivity":
        """The sensitivity of a model of this name to at least one input, with its draws."""
        names = (name if name in SHARED or name.startswith(LABELS) else f"{model}: {name}" for name in changes)
        streams = (np.random.default_rng([seed, zlib.crc32(name.encode())]) for name in names)
        return cls(changes, np.column_stack([stream.standard_normal(draws) for stream in streams]))

    def drawn(self, number: int) -> FloatArray:
        """Change (n,) of the maximum shear strain in a draw."""
        return np.asarray(self.numbers[number] @ self._stacked)


def changes_of(
    model: OnMesh, variants: Iterable[Variant], points_mm: FloatArray, volumes_ml: FloatArray,
    tissues: Sequence[BoolArray],
) -> dict[str, FloatArray]:  # fmt: skip
    """Change of a model's maximum shear strain at points by one standard uncertainty of each input.

    Parameters
    ----------
    model : OnMesh
        The model itself.
    points_mm, volumes_ml : (n, 3), (n,)
        Points of the reference configuration, LPS mm, and the volume that each stands for.
    tissues : sequence of (n,)
        Points of each tissue.

    Notes
    -----
    A variant on the same cells as its base changes them one by one: the change is that of the cell at the point, or of
    the nearest cell outside the mesh. Its nodes may have been moved. Between two meshes the strain of single cells
    differs by scatter that does not affect the strain-volume curve. There the change is that of the quantiles: in each
    tissue, the difference between the strains that the same fraction of the volume exceeds. Of several variants of one
    input, such as one increased and one decreased, the mean is taken.
    """
    cells: dict[object, tuple[OnMesh, np.ndarray]] = {}
    summed: dict[str, list[FloatArray]] = {}
    for variant in variants:
        if variant.base not in cells:
            base = model if variant.base is None else variant.base()
            cells[variant.base] = base, _nearest_cells(base, points_mm)
        (base, at), varied = cells[variant.base], variant.read()
        before = _max_shear(base)[at]
        if np.array_equal(varied.mesh.cells, base.mesh.cells):
            change = _max_shear(varied)[at] - before
        else:
            own = before if variant.base is None else _max_shear(model)[_nearest_cells(model, points_mm)]
            after = _max_shear(varied)[_nearest_cells(varied, points_mm)]
            change = np.zeros(len(points_mm))
            for inside in tissues:
                of = own[inside], before[inside], after[inside]
                change[inside] = _by_quantile(*of, volumes_ml[inside])
        summed.setdefault(variant.input, []).append(change / variant.steps)
    return {name: np.mean(of, axis=0) for name, of in summed.items()}


def _max_shear(solution: OnMesh) -> FloatArray:
    return np.asarray(StrainField.from_gradient(solution.cell_gradients).max_shear)


def _nearest_cells(solution: OnMesh, points_mm: FloatArray) -> np.ndarray:
    """Cell of each point (n,); the one with the nearest centroid outside the mesh."""
    found = solution.cells_at(points_mm)
    if len(outside := np.flatnonzero(found < 0)):
        found[outside] = cKDTree(solution.mesh.centroids_mm).query(points_mm[outside])[1]
    return found


def _by_quantile(own: FloatArray, before: FloatArray, after: FloatArray, volumes_ml: FloatArray) -> FloatArray:
    """Difference of two distributions (n,) at the quantile of each value (n,) in its own distribution."""

    def shares(values: FloatArray) -> tuple[np.ndarray, FloatArray]:
        order = np.argsort(values, kind="stable")
        volumes = volumes_ml[order]
        return order, (np.cumsum(volumes) - 0.5 * volumes) / volumes.sum()

    ranked, share = shares(own)
    change = np.zeros(len(own))
    for values, sign in ((after, 1.0), (before, -1.0)):
        order, at = shares(values)
        change[ranked] += sign * np.interp(share, at, values[order])
    return change
