"""Strain location: clusters of tissue above a strain threshold, their overlap and distance, with 95 % intervals."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dvc import TetMesh
from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError
from dvc.mesh import faces_of
from dvc.tables import read_table
from dvc.trust.uncertainty import widened

LEAST_ML = 0.1
"""Default volume of the smallest cluster that counts, mL."""

LOCATION_DRAWS = 60
"""Number of true fields for the location of a load: the first of those drawn for the curves."""

_CELLS = 1000  # per draw, for the Hausdorff distance; changes its percentile by 0.7 points, less than between draws
_ENOUGH = 0.5  # fraction of the draws that must have a value


@dataclass(frozen=True, slots=True)
class Threshold:
    """A maximum shear strain above which clusters are compared, and the source of the value."""

    max_shear: float
    source: str


def read_thresholds(path: Path | None = None) -> tuple[Threshold, ...]:
    """Read thresholds from a CSV table; by default the one in the package.

    Columns are max_shear, a maximum shear strain (E1 - E3) / 2 between 0 and 3 (not in percent), and source, a text.
    InputError as `dvc.tables.read_table`, and if a column is missing or the table has no row.
    """
    place = path if path is not None else Path(str(files("validate") / "thresholds.csv"))
    columns, rows = read_table(place)
    try:
        value, source = columns.index("max_shear"), columns.index("source")
        thresholds = tuple(Threshold(float(row[value]), row[source]) for _, row in rows)
    except ValueError as error:
        raise InputError(f"{place}: a table of thresholds needs the columns max_shear and source ({error}).") from error
    if not thresholds or not all(0.0 < t.max_shear < 3.0 for t in thresholds):
        raise InputError(
            f"{place}: thresholds must be maximum shear strains between 0 and 3 (not in percent); got "
            f"{[t.max_shear for t in thresholds]}."
        )
    return thresholds


@dataclass(frozen=True, slots=True, eq=False)
class StrainCluster:
    """Connected cells above a threshold of maximum shear strain.

    Numbers (k,) of the cells; their volume, mL, volume-weighted mean of the maximum shear strain, and centroid (3,) in
    the reference configuration, LPS mm.
    """

    cells: IntArray
    volume_ml: float
    mean_shear: float
    centroid_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CellGraph:
    """Cells of a mesh and their neighbours.

    Volumes (n,), mL, and centroids (n, 3), LPS mm, in the reference configuration; adjacency (n, n), sparse, one
    entry for each pair of cells with a common face.
    """

    volumes_ml: FloatArray
    points_mm: FloatArray
    adjacency: sparse.csr_matrix

    @classmethod
    def of(cls, mesh: TetMesh) -> Self:
        """All cells of a mesh."""
        count = len(mesh.cells)
        faces = faces_of(mesh.cells)
        order = np.lexsort(faces.T)
        same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
        first, second = order[:-1][same] % count, order[1:][same] % count
        pairs = sparse.csr_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
        return cls(mesh.volumes_mm3 / 1000.0, mesh.centroids_mm, pairs)

    def part(self, kept: BoolArray) -> Self:
        """The graph of some of the cells (n,)."""
        return type(self)(self.volumes_ml[kept], self.points_mm[kept], self.adjacency[kept][:, kept])

    def clusters(self, above: BoolArray, shear: FloatArray, least_ml: float = LEAST_ML) -> list[StrainCluster]:
        """Clusters of the cells ``above`` (n,) with at least the volume ``least_ml``, largest first; ``shear`` (n,)."""
        cells, number = self._components(above)
        kept = []
        for n in range(number.max() + 1 if len(cells) else 0):
            members = cells[number == n]
            volume = self.volumes_ml[members]
            if volume.sum() >= least_ml:
                weight = volume / volume.sum()
                mean, centroid = float(weight @ shear[members]), weight @ self.points_mm[members]
                kept.append(StrainCluster(members, float(volume.sum()), mean, centroid))
        return sorted(kept, key=lambda c: -c.volume_ml)

    def region(self, above: BoolArray, least_ml: float = LEAST_ML) -> "StrainedRegion":
        """All cells ``above`` (n,) in clusters with at least the volume ``least_ml``."""
        cells, number = self._components(above)
        kept = np.zeros(len(above), dtype=bool)
        if len(cells):
            kept[cells] = np.bincount(number, self.volumes_ml[cells])[number] >= least_ml
        return StrainedRegion(kept, self)

    def _components(self, above: BoolArray) -> tuple[IntArray, IntArray]:
        """The cells above, and the number of the cluster of each."""
        cells = np.flatnonzero(above)
        number = connected_components(self.adjacency[cells][:, cells], directed=False)[1] if len(cells) else cells
        return cells, number


@dataclass(frozen=True, slots=True)
class Overlap:
    """Overlap and distance of the clusters above a threshold, measured and simulated; a row of location.csv.

    Attributes
    ----------
    measured_ml, model_ml : float
        Volume of the clusters; the strain-volume curves also include strained cells outside clusters.
    measured_mean, model_mean : float
        Volume-weighted mean of the maximum shear strain in them; NaN where there is none.
    dice : float
        Dice coefficient: twice the common volume over the sum of both.
    centroids_mm, largest_mm : float
        Distance of the centroids, mm: of all clusters together, and of the largest of each.
    hausdorff95_mm : float
        Hausdorff distance at the 95th percentile (by volume), the larger of both directions, mm.
    measured_low_ml, measured_high_ml, dice_low ... : float
        95 % intervals from the measurement uncertainty, and the value that a perfect model would get; NaN without an
        error model. See `validate.location.with_intervals`.
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
    model: str, load: str, threshold: float, measured: FloatArray, simulated: FloatArray,
    cells: CellGraph, least_ml: float = LEAST_ML,
) -> Overlap:  # fmt: skip
    """Compare the clusters above a threshold of two fields on the same cells; undefined values are NaN.

    Parameters
    ----------
    model, load : str
        Names in tables.
    threshold : float
        Maximum shear strain above which cells are compared.
    measured, simulated : (n,)
        Maximum shear strain (E1 - E3) / 2 in the cells.
    cells, least_ml : CellGraph, float
        The cells, and the volume of the smallest cluster that counts, mL.
    """
    of, to = (cells.clusters(shear > threshold, shear, least_ml) for shear in (measured, simulated))
    first, second = (cells.region(shear > threshold, least_ml) for shear in (measured, simulated))
    largest = float(np.linalg.norm(of[0].centroid_mm - to[0].centroid_mm)) if of and to else float("nan")
    return Overlap(
        model, load, threshold, first.volume_ml, second.volume_ml, len(of), len(to), first.mean_of(measured),
        second.mean_of(simulated), dice(first, second), centroid_distance(first, second), largest,
        hausdorff95(first, second),
    )  # fmt: skip


class StrainedRegion:
    """Cells (n,) in clusters ``above`` a threshold."""

    def __init__(self, above: BoolArray, cells: CellGraph) -> None:
        self.above, self.volumes, self._points = above, cells.volumes_ml, cells.points_mm
        self.volume_ml = float(self.volumes[above].sum())

    @cached_property
    def _near(self) -> cKDTree:
        return cKDTree(self._points[self.above])

    @cached_property
    def centroid_mm(self) -> FloatArray:
        """Reference configuration, LPS mm; NaN for no cell."""
        if not self.above.any():
            return np.full(3, np.nan)
        return np.asarray(self.volumes[self.above] @ self._points[self.above] / self.volume_ml)

    def mean_of(self, values: FloatArray) -> float:
        """Volume-weighted mean of values (n,); NaN for no cell."""
        inside = self.above
        return float(self.volumes[inside] @ values[inside] / self.volume_ml) if inside.any() else float("nan")

    def distance95(self, other: Self, most: int | None = None) -> float:
        """95th percentile (by volume) of the distance of the cells (at most ``most`` of them) to another region, mm."""
        cells = np.flatnonzero(self.above)
        cells = cells[:: max(1, len(cells) // most)] if most else cells
        alone = ~other.above[cells]
        distance = np.zeros(len(cells))
        distance[alone] = other._near.query(self._points[cells[alone]])[0]
        order = np.argsort(distance)
        volume = np.cumsum(self.volumes[cells[order]])
        return float(distance[order][min(int(np.searchsorted(volume, 0.95 * volume[-1])), len(order) - 1)])


def dice(first: StrainedRegion, second: StrainedRegion) -> float:
    """Twice the common volume over the sum of both (Dice 1945); NaN where both are empty."""
    both, shared = first.volume_ml + second.volume_ml, float(first.volumes[first.above & second.above].sum())
    return 2.0 * shared / both if both > 0.0 else float("nan")


def centroid_distance(first: StrainedRegion, second: StrainedRegion) -> float:
    """Distance of the centroids, mm; NaN where one is empty."""
    return float(np.linalg.norm(first.centroid_mm - second.centroid_mm))


def hausdorff95(first: StrainedRegion, second: StrainedRegion, most: int | None = None) -> float:
    """Hausdorff distance at the 95th percentile, mm; NaN where one is empty. ``most`` as in `distance95`."""
    both = first.above.any() and second.above.any()
    return max(first.distance95(second, most), second.distance95(first, most)) if both else float("nan")


_FIGURES: dict[str, Callable[[StrainedRegion, StrainedRegion], float]] = {
    "dice{}": dice,
    "centroids{}_mm": centroid_distance,
    "hausdorff95{}_mm": partial(hausdorff95, most=_CELLS),
}


def with_intervals(
    overlaps: Sequence[Overlap], truths: Sequence[FloatArray], models: Mapping[str, FloatArray],
    cells: CellGraph, least_ml: float, widening: float,
) -> list[Overlap]:  # fmt: skip
    """Overlaps of a load with 95 % intervals from drawn true fields, and with the value of a perfect model.

    Truths and models are the maximum shear strain in ``cells`` (n,); ``widening`` is the factor on intervals of draws,
    see `dvc.trust.error_model.ErrorTable`. The value of a perfect model is the median between one drawn true field and
    the next: noise alone reduces a Dice coefficient and increases a distance to this value. An interval that reaches it
    is extended to 1, or to 0 mm. Distances have an interval if at least half of the draws have tissue above the
    threshold.
    """
    rows: list[Overlap] = []
    for threshold in dict.fromkeys(o.threshold for o in overlaps):
        regions = [cells.region(truth > threshold, least_ml) for truth in truths]
        least, _, most = _interval([region.volume_ml for region in regions], widening)
        most = min(most, float(cells.volumes_ml.sum()))
        neighbours = list(pairwise(regions))
        perfect = {figure: _interval([of(*pair) for pair in neighbours], 1.0)[1] for figure, of in _FIGURES.items()}
        for one in (o for o in overlaps if o.threshold == threshold):
            model = cells.region(models[one.model] > threshold, least_ml)
            values: dict[str, Any] = {"measured_low_ml": least, "measured_high_ml": most}
            for figure, of in _FIGURES.items():
                low, _, high = _interval([of(region, model) for region in regions], widening)
                if of is dice:
                    high = 1.0 if high >= perfect[figure] else high
                elif low <= perfect[figure]:
                    low = 0.0
                ends = {"_low": low, "_high": high, "_perfect": perfect[figure]}
                values |= {figure.format(end): value for end, value in ends.items()}
            rows.append(replace(one, **values))
    order = {(o.model, o.threshold): n for n, o in enumerate(overlaps)}
    return sorted(rows, key=lambda o: order[o.model, o.threshold])


def _interval(drawn: Sequence[float], widening: float) -> tuple[float, float, float]:
    """Lower end, median and upper end of draws; NaN if too few have a value."""
    known = np.array([d for d in drawn if not np.isnan(d)])
    if len(known) < max(2.0, _ENOUGH * len(drawn)):
        return (float("nan"),) * 3
    low, middle, high = (float(v[0]) for v in widened(known[:, None], widening))
    return low, middle, high
