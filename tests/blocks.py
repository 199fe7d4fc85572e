"""Blocks of tetrahedra for tests of the finite elements."""

import itertools

import numpy as np

from dvc.mesh import TetMesh


def block(
    count: tuple[int, int, int], size_mm: tuple[float, float, float], layers: int = 1, wobble: float = 0.0
) -> TetMesh:
    """A box from the origin, each of its cubes cut into six tetrahedra around a diagonal.

    Regions "layer 0", "layer 1" ... are slices along x; facets "x0", "x1", "y0" ... its sides. Inner nodes are moved by
    up to ``wobble`` of a cube, so that nothing is as regular as in a lattice.
    """
    axes = [np.linspace(0.0, s, n + 1) for n, s in zip(count, size_mm, strict=True)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inner = np.ones(at.shape[:3], dtype=bool)
    for axis in range(3):
        moved = np.moveaxis(inner, axis, 0)
        moved[0] = moved[-1] = False
    step = np.array(size_mm) / count
    at[inner] += wobble * step * np.random.default_rng(0).uniform(-1, 1, (int(inner.sum()), 3))
    number = np.arange(at[..., 0].size).reshape(at.shape[:3])
    cells = []
    for order in itertools.permutations(range(3)):
        corner = np.zeros(3, dtype=int)
        path = [tuple(corner)]
        for axis in order:
            corner[axis] = 1
            path.append(tuple(corner))
        cells.append([_corner(number, c) for c in path])
    tets = np.concatenate([np.stack(c, axis=1) for c in cells])
    points = at.reshape(-1, 3)
    corners = points[tets]
    flipped = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    tets[flipped] = tets[flipped][:, [0, 1, 3, 2]]
    slab = np.minimum((points[tets][:, :, 0].mean(axis=1) / size_mm[0] * layers).astype(int), layers - 1)
    regions = {f"layer {k}": np.flatnonzero(slab == k) for k in range(layers)}
    faces = np.sort(np.concatenate([tets[:, f] for f in ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))]), axis=1)
    faces, times = np.unique(faces, axis=0, return_counts=True)
    outer = faces[times == 1]
    facets = {}
    for axis, name in enumerate("xyz"):
        for end, value in enumerate((0.0, size_mm[axis])):
            facets[f"{name}{end}"] = outer[(np.abs(points[outer][:, :, axis] - value) < 1e-9).all(axis=1)]
    return TetMesh(points, tets, regions, facets)


def _corner(number: np.ndarray, corner: tuple[int, ...]) -> np.ndarray:
    return number[tuple(slice(c, n - 1 + c) for c, n in zip(corner, number.shape, strict=True))].ravel()
