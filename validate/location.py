"""Strain location: connected tissue above a strain, measured and simulated, and how far apart the two lie."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError
from dvc.mesh import FACES, TetMesh

LEAST_ML = 0.1
"""Volume under which a cluster is not told, by default."""


@dataclass(frozen=True, slots=True)
class Threshold:
    """A maximal shear above which tissue is looked at, and where the number comes from."""

    max_shear: float
    source: str


def read_thresholds(path: Path | None = None) -> tuple[Threshold, ...]:
    """Thresholds of a table with columns max_shear and source; by default that which comes with the package.

    Raises
    ------
    InputError
        If there is no such table, or a value is none of a strain.
    """
    place = path if path is not None else files("validate") / "thresholds.csv"
    try:
        rows = list(csv.DictReader(place.read_text(encoding="utf-8").splitlines(), restval=""))
        found = tuple(Threshold(float(row["max_shear"]), row["source"].strip()) for row in rows)
    except OSError as error:
        raise InputError(f"{place} cannot be read as thresholds: {error.strerror}.") from error
    except (KeyError, ValueError, AttributeError) as error:
        raise InputError(f"{place}: a table of thresholds has the columns max_shear and source ({error}).") from error
    if not found or not all(0.0 < t.max_shear < 3.0 for t in found):
        raise InputError(
            f"{place}: thresholds are maximal shears between 0 and 3 (no percent); it has "
            f"{[t.max_shear for t in found]}."
        )
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Connected cells above a threshold.

    Attributes
    ----------
    cells : (k,)
    volume_ml, mean_shear : float
    centroid_mm : (3,)
        Reference configuration, LPS.
    """

    cells: IntArray
    volume_ml: float
    mean_shear: float
    centroid_mm: FloatArray


def neighbours(mesh: TetMesh) -> sparse.csr_matrix:
    """Which cells share a face, (m, m)."""
    count = len(mesh.cells)
    faces = np.sort(np.concatenate([mesh.cells[:, face] for face in FACES]), axis=1)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    first, second = order[:-1][same] % count, order[1:][same] % count
    return sparse.csr_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))


def clusters(
    above: BoolArray,
    shear: FloatArray,
    volumes_ml: FloatArray,
    points_mm: FloatArray,
    touching: sparse.csr_matrix,
    least_ml: float = LEAST_ML,
) -> list[Cluster]:
    """Clusters of cells ``above`` (n,), connected through faces, of at least a volume; the largest first."""
    cells = np.flatnonzero(above)
    if not len(cells):
        return []
    _, number = connected_components(touching[cells][:, cells], directed=False)
    found = []
    for n in range(number.max() + 1):
        members = cells[number == n]
        volume = volumes_ml[members]
        if volume.sum() >= least_ml:
            share = volume / volume.sum()
            found.append(
                Cluster(members, float(volume.sum()), float(share @ shear[members]), share @ points_mm[members])
            )
    return sorted(found, key=lambda c: -c.volume_ml)


def in_clusters(
    above: BoolArray, volumes_ml: FloatArray, touching: sparse.csr_matrix, least_ml: float = LEAST_ML
) -> BoolArray:
    """Those of the cells ``above`` (n,) that lie in a cluster of at least a volume."""
    cells = np.flatnonzero(above)
    kept = np.zeros(len(above), dtype=bool)
    if len(cells):
        _, number = connected_components(touching[cells][:, cells], directed=False)
        kept[cells] = np.bincount(number, volumes_ml[cells])[number] >= least_ml
    return kept


@dataclass(frozen=True, slots=True)
class Overlap:
    """Where a model and the measurement put tissue above a threshold, in clusters of at least the least volume.

    Attributes
    ----------
    model, load : str
    threshold : float
        Maximal shear.
    measured_ml, model_ml : float
        Volume of the clusters; all that lies above, specks too, is in the volume-strain curves.
    measured_clusters, model_clusters : int
        How many.
    measured_mean, model_mean : float
        Mean maximal shear in them, by volume; NaN where there is none.
    dice : float
        Twice the common volume over the sum of both.
    centroids_mm : float
        Distance of the centroids of all clusters together.
    largest_mm : float
        The same of the largest cluster of each.
    hausdorff95_mm : float
        95th percentile, by volume, of the distance of either to the other; the larger of the two.
    measured_low_ml, measured_high_ml, dice_low ... : float
        95 % intervals from the measurement's error, and what a perfect model would be given; NaN where the error is
        not known. See `validate.location_intervals`.
    """

    model: str
    load: str
    threshold: float
    measured_ml: float
    model_ml: float
    measured_clusters: int
    model_clusters: int
    measured_mean: float
    model_mean: float
    dice: float
    centroids_mm: float
    largest_mm: float
    hausdorff95_mm: float
    measured_low_ml: float = float("nan")
    measured_high_ml: float = float("nan")
    dice_low: float = float("nan")
    dice_high: float = float("nan")
    dice_perfect: float = float("nan")
    centroids_low_mm: float = float("nan")
    centroids_high_mm: float = float("nan")
    centroids_perfect_mm: float = float("nan")
    hausdorff95_low_mm: float = float("nan")
    hausdorff95_high_mm: float = float("nan")
    hausdorff95_perfect_mm: float = float("nan")


def overlap(
    model: str,
    load: str,
    threshold: float,
    measured: FloatArray,
    simulated: FloatArray,
    volumes_ml: FloatArray,
    points_mm: FloatArray,
    touching: sparse.csr_matrix,
    least_ml: float = LEAST_ML,
) -> Overlap:
    """Compare what lies above a threshold in two fields (n,) on the same cells; figures without a meaning are NaN."""
    fields = (measured, simulated)
    found = [clusters(shear > threshold, shear, volumes_ml, points_mm, touching, least_ml) for shear in fields]
    above = [in_clusters(shear > threshold, volumes_ml, touching, least_ml) for shear in fields]
    both = [Part(cells, volumes_ml, points_mm) for cells in above]
    means = [part.mean_of(shear) for part, shear in zip(both, fields, strict=True)]
    largest = float("nan")
    if all(found):
        largest = float(np.linalg.norm(found[0][0].centroid_mm - found[1][0].centroid_mm))
    return Overlap(
        model, load, threshold, both[0].volume_ml, both[1].volume_ml, len(found[0]), len(found[1]),
        means[0], means[1], dice(both[0], both[1]), centroids_apart(both[0], both[1]), largest,
        hausdorff95(both[0], both[1]),
    )  # fmt: skip


class Part:
    """Cells in clusters above a threshold, and what their place is told by.

    Attributes
    ----------
    above : (n,) bool
    volume_ml : float
    """

    def __init__(self, above: BoolArray, volumes_ml: FloatArray, points_mm: FloatArray) -> None:
        self.above = above
        self._volumes, self._points = volumes_ml, points_mm
        self.volume_ml = float(volumes_ml[above].sum())

    @cached_property
    def _near(self) -> cKDTree:
        return cKDTree(self._points[self.above])

    @property
    def centroid_mm(self) -> FloatArray:
        """Reference configuration, LPS mm; NaN for no cell."""
        if not self.above.any():
            return np.full(3, np.nan)
        return np.asarray(self._volumes[self.above] @ self._points[self.above] / self.volume_ml)

    def mean_of(self, values: FloatArray) -> float:
        """Mean of values (n,) by volume; NaN for no cell."""
        inside = self.above
        return float(self._volumes[inside] @ values[inside] / self.volume_ml) if inside.any() else float("nan")

    def shared_ml(self, other: Part) -> float:
        """Volume common to both."""
        return float(self._volumes[self.above & other.above].sum())

    def distance95(self, other: Part, most: int | None = None) -> float:
        """95th percentile, by volume, of the distance of these cells to the nearest of the other's, mm.

        With ``most``, of so many or fewer of the cells, taken at equal steps.
        """
        cells = np.flatnonzero(self.above)
        cells = cells[:: max(1, len(cells) // most)] if most else cells
        alone = ~other.above[cells]
        distance = np.zeros(len(cells))
        distance[alone] = other._near.query(self._points[cells[alone]])[0]
        order = np.argsort(distance)
        share = np.cumsum(self._volumes[cells[order]])
        return float(distance[order][min(int(np.searchsorted(share, 0.95 * share[-1])), len(order) - 1)])


def dice(first: Part, second: Part) -> float:
    """Twice the common volume over the sum of both (Dice 1945); NaN where both are empty."""
    both = first.volume_ml + second.volume_ml
    return 2.0 * first.shared_ml(second) / both if both > 0.0 else float("nan")


def centroids_apart(first: Part, second: Part) -> float:
    """Distance of the centroids, mm; NaN where one is empty."""
    return float(np.linalg.norm(first.centroid_mm - second.centroid_mm))


def hausdorff95(first: Part, second: Part, most: int | None = None) -> float:
    """Larger of the two distances at their 95th percentiles, mm; NaN where one is empty. ``most`` as in `Part`."""
    if not (first.above.any() and second.above.any()):
        return float("nan")
    return max(first.distance95(second, most), second.distance95(first, most))
