"""What a few marks tell: tissues that brightness alone does not find, and corrections where it was wrong."""

from collections.abc import Mapping

import numpy as np
from scipy.ndimage import gaussian_filter, label
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.images.image import Grid, Mask
from dvc.images.tissue import within
from dvc.labelling.brightness import Levels, brighter_share

_BORDER_MM = 0.1  # of a marked tissue, which may be a sheet of two voxels
_REACH_MM = 8.0  # of a correction
_BLUR_MM, _TRUNCATED = 0.5, 4.0  # standard deviation of a Gaussian, and how many of them it reaches
_EVEN = 3.0  # times the median step between neighbouring voxels: a walk avoids larger steps
_LEAST_WEIGHT = 1e-4
_CONVERGED = 1e-5
_REACHED = 0.5
_LEAST_STEP = 0.15  # between the brightness of a marked tissue and that of muscle, as a share of the latter


def grown(
    values: Float32Array, mark: BoolArray, where: BoolArray, other: float, spacing_mm: FloatArray
) -> Float32Array:
    """Probability (ni, nj, nk) of a marked tissue, darker or brighter than the ``other`` tissue around it.

    It is the part that has the mark's brightness and is joined to the mark. A tissue that is about as bright as the
    other one is only where it is marked.
    """
    chance = mark.astype(np.float32)
    if not mark.any():
        return chance
    own = float(np.median(values[mark]))
    if abs(own - other) < _LEAST_STEP * abs(other):
        return chance
    levels = Levels(min(own, other), max(own, other), 0.5 * (own + other))
    share = brighter_share(values, where, levels, spacing_mm, _BORDER_MM)
    likely = share if own > other else 1.0 - share
    parts, _ = label((likely > 0.5) & where | mark)
    joined = np.isin(parts, np.unique(parts[mark]))
    return np.where(joined, np.maximum(likely, chance), 0.0).astype(np.float32)


def corrected(
    values: Float32Array, probability: Float32Array, where: BoolArray, marks: Mapping[int, BoolArray], grid: Grid
) -> Float32Array:
    """Probability (n, ni, nj, nk) of tissues, found again within 8 mm of the marks that they do not agree with.

    There each voxel gets the tissue that a random walk from it most likely reaches first: a mark, or the tissues
    beyond 8 mm as they are (L. Grady 2006, doi:10.1109/TPAMI.2006.233). A walk avoids steps of brightness, and what has
    the tissue that a mark contradicts, but the brightness of the mark. Only the tissues of these marks and those that
    they contradict change: beside a mark of muscle in fat, skin and bone stay as they are.

    Parameters
    ----------
    values : (ni, nj, nk)
        Image without its bias field.
    probability : (n, ni, nj, nk)
        Probability of each tissue.
    where : (ni, nj, nk) bool
        Voxels that may change: the body without a bone that is known. Marks lie in it.
    marks : mapping
        Marked voxels (ni, nj, nk) by the place of their tissue in ``probability``.
    grid : Grid
        Voxels, LPS mm.
    """
    found = np.array(probability)
    labels = np.where(where, found.argmax(axis=0) + 1, -1)  # no walk goes to -1
    wrong = np.zeros(grid.shape, dtype=bool)
    fixed = np.zeros(grid.shape, dtype=np.int64)
    for number, mark in marks.items():
        wrong |= mark & (labels != number + 1)
        fixed[mark] = number + 1
    parts, count = label(within(wrong, grid.spacing_mm, _REACH_MM))
    for part in range(1, count + 1):
        box = Mask(grid, parts == part).box(around=2)
        here, marked, blurred = labels[box], fixed[box], _blurred(values, box, grid.spacing_mm)
        at = wrong[box] & (parts[box] == part)
        concerned = np.unique(np.concatenate([here[at], marked[at]]))
        here, marked = (np.where(np.isin(of, concerned), of, none) for of, none in ((here, -1), (marked, 0)))
        again = (parts[box] == part) & (here > 0)
        doubted = _as_the_marks(blurred, here, at)
        seeds = np.where(again, 0, np.where(doubted, -1, here))
        seeds = np.where(marked > 0, marked, seeds)
        present = np.unique(seeds[seeds > 0])
        numbered = np.where(seeds > 0, np.searchsorted(present, seeds) + 1, seeds)
        walked = _walked(blurred, numbered, len(present), grid.spacing_mm)
        total = walked.sum(axis=0)  # 1, but for what conjugate gradients leave, and 0 where no walk reaches a seed
        inside = again & (total > _REACHED)
        chance = np.zeros((len(found), *seeds.shape), dtype=np.float32)
        chance[present - 1] = walked / np.maximum(total, _REACHED)
        found[(slice(None), *box)] = np.where(inside, chance, found[(slice(None), *box)])
    return found


def _blurred(values: Float32Array, box: tuple[slice, ...], spacing_mm: FloatArray) -> Float32Array:
    """Values in a box of the image, blurred as in the whole of it."""
    sigma = _BLUR_MM / spacing_mm
    reach = np.rint(_TRUNCATED * sigma + 0.5).astype(int)
    wider = tuple(slice(max(one.start - int(n), 0), one.stop + int(n)) for one, n in zip(box, reach, strict=True))
    inner = tuple(slice(one.start - w.start, one.stop - w.start) for one, w in zip(box, wider, strict=True))
    return np.asarray(gaussian_filter(values[wider], sigma, truncate=_TRUNCATED)[inner], dtype=np.float32)


def _as_the_marks(values: Float32Array, labels: IntArray, marks: BoolArray) -> BoolArray:
    """Voxels with a label that marks contradict, whose brightness is nearer to that of these marks than to its own."""
    doubted = np.zeros(labels.shape, dtype=bool)
    for number in np.unique(labels[marks]):
        mine = labels == number
        own, marked = float(np.median(values[mine])), float(np.median(values[marks & mine]))
        doubted |= mine & (np.abs(values - marked) < np.abs(values - own))
    return doubted


def _walked(values: Float32Array, seeds: IntArray, count: int, spacing_mm: FloatArray) -> FloatArray:
    """Probability (count, i, j, k) that a random walk from a voxel ends at a seed 1, 2 and so on; it keeps off -1."""
    free = seeds == 0
    number = np.full(seeds.shape, -1, dtype=np.int64)
    number[free] = np.arange(np.count_nonzero(free))
    rows, columns, weights = list[IntArray](), list[IntArray](), list[FloatArray]()
    known, degree = np.zeros((int(free.sum()), count)), np.zeros(int(free.sum()))
    steps = [np.abs(np.diff(values, axis=axis)) for axis in range(3)]
    usual = _EVEN * float(np.median(np.concatenate([one.ravel() for one in steps]))) + 1e-12
    for axis, step in enumerate(steps):
        weight = (np.exp(-((step / usual) ** 2)) + _LEAST_WEIGHT) / spacing_mm[axis] ** 2
        low, high = (np.take(seeds, np.arange(n, n + step.shape[axis]), axis) for n in (0, 1))
        at_low, at_high = (np.take(number, np.arange(n, n + step.shape[axis]), axis) for n in (0, 1))
        for here, there, seed in ((at_low, at_high, high), (at_high, at_low, low)):
            inner, edge = (here >= 0) & (there >= 0), (here >= 0) & (seed > 0)
            rows.append(here[inner])
            columns.append(there[inner])
            weights.append(weight[inner])
            np.add.at(known, (here[edge], seed[edge] - 1), weight[edge])
            np.add.at(degree, here[inner | edge], weight[inner | edge])
    size = len(known)
    degree[degree == 0.0] = 1.0  # a voxel that no walk leaves
    off = coo_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), (size, size)).tocsr()
    laplacian, scale = diags_array(degree) - off, diags_array(1.0 / degree)
    found = np.zeros((count, *seeds.shape))
    for n in range(count):
        found[n][seeds == n + 1] = 1.0
        if size:
            found[n][free] = cg(laplacian, known[:, n], rtol=_CONVERGED, M=scale, maxiter=1000)[0]
    return np.clip(found, 0.0, 1.0)
