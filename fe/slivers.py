"""Nearly flat cells: recognised by their dihedral angles, improved by moving their nodes."""

import numpy as np

from dvc.arrays import FloatArray, IntArray
from dvc.mesh import FACES, signed_volumes

_FLAT = 0.02  # fraction of the largest variance of the normals around a node, below which a surface counts as straight
_STEPS = (0.2, 0.1, 0.05, 0.02)  # of the mean edge around a node
_FARTHEST = 0.4  # of the mean edge: largest total move of a node
_PASSES = 12
_DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)]) - 1.0
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)


def dihedral_angles_deg(corners: FloatArray) -> FloatArray:
    """The six angles between the faces of tetrahedra (..., 6), degrees, from their corners (..., 4, 3)."""
    normals = []
    for a, b, c, d in ((1, 2, 3, 0), (0, 2, 3, 1), (0, 1, 3, 2), (0, 1, 2, 3)):
        normal = np.cross(corners[..., b, :] - corners[..., a, :], corners[..., c, :] - corners[..., a, :])
        inward = np.einsum("...i,...i->...", normal, corners[..., d, :] - corners[..., a, :]) > 0
        normal[inward] *= -1.0
        normals.append(normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300))
    cosines = [np.einsum("...i,...i->...", normals[i], normals[j]) for i in range(4) for j in range(i)]
    return np.asarray(180.0 - np.degrees(np.arccos(np.clip(np.stack(cosines, axis=-1), -1.0, 1.0))))


def without_slivers(points_mm: FloatArray, cells: IntArray, tissue: IntArray, goal_deg: float = 12.0) -> FloatArray:
    """Nodes (n, 3), mm, moved until no dihedral angle is within ``goal_deg`` of 0 or 180 degrees, or no move helps.

    All ``cells`` (m, 4) have the same orientation. Cells of different ``tissue`` (m,) meet in an interface. Its nodes
    stay on it: they slide in its plane or along its edges, and its corners are fixed. Each node of a flat cell tries
    steps in 26 directions and takes the one that improves the worst angle of its cells most; its total move is at most
    two fifths of an edge. This is optimisation-based smoothing (L. A. Freitag and C. Ollivier-Gooch 1997,
    doi:10.1002/(SICI)1097-0207(19971115)40:21<3979::AID-NME251>3.0.CO;2-9), without derivatives.
    """
    points = points_mm.copy()
    free = _freedom(points, cells, tissue)
    sign = float(np.sign(np.median(signed_volumes(points[cells]))))
    owners = np.argsort(cells, axis=None, kind="stable") // cells.shape[1]
    first = np.concatenate([[0], np.cumsum(np.bincount(cells.ravel(), minlength=len(points)))])
    for _ in range(_PASSES):
        flat = _goodness(points[cells], sign) < goal_deg
        moved = False
        for node in np.unique(cells[flat]):
            star = cells[owners[first[node] : first[node + 1]]]
            moved |= _move(points, points_mm[node], star, sign, free[node], int(node), goal_deg)
        if not moved:
            break
    return points


def _goodness(corners: FloatArray, sign: float) -> FloatArray:
    """Smallest distance of a cell's dihedral angles from 0 and 180 degrees (...); negative for an inverted cell."""
    angles = dihedral_angles_deg(corners)
    worst = np.minimum(angles, 180.0 - angles).min(axis=-1)
    return np.asarray(np.where(signed_volumes(corners) * sign > 0, worst, -1.0))


def _freedom(points: FloatArray, cells: IntArray, tissue: IntArray) -> FloatArray:
    """Projections (n, 3, 3) onto the directions in which each node may move: all, a plane, an edge, or none."""
    faces = np.concatenate([cells[:, face] for face in FACES])
    _, first, which = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    which, owner = which.ravel(), np.tile(tissue, 4)
    sides = np.bincount(which)
    alike = np.bincount(which, weights=owner == owner[first][which])
    border = faces[first[(sides == 1) | (alike < sides)]]
    a, b, c = (points[border[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    around = np.zeros((len(points), 3, 3))
    for corner in border.T:
        np.add.at(around, corner, normal[:, :, None] * normal[:, None, :])
    free = np.tile(np.eye(3), (len(points), 1, 1))
    nodes = np.unique(border)
    spread, axes = np.linalg.eigh(around[nodes])
    along = (spread < _FLAT * spread[:, 2:]).astype(float)  # axes tangential to all faces around the node
    free[nodes] = np.einsum("nik,nk,njk->nij", axes, along, axes)
    return free


def _move(
    points: FloatArray, start: FloatArray, star: IntArray, sign: float, free: FloatArray, node: int, goal: float
) -> bool:
    """Move a node to where the worst of its cells (the star) is best, if one of them is flat; whether it moved."""
    directions = _DIRECTIONS @ free
    if not directions.any():
        return False
    corners, own = points[star], star == node
    edge = float(np.linalg.norm(corners - points[node], axis=-1)[~own].mean())
    now, moved = float(_goodness(corners, sign).min()), False
    if now >= goal:
        return False
    for step in _STEPS:
        while True:
            tried = points[node] + step * edge * directions
            tried = tried[np.linalg.norm(tried - start, axis=1) < _FARTHEST * edge]
            if not len(tried):
                break
            stars = np.where(own[..., None], tried[:, None, None, :], corners)
            worst = _goodness(stars, sign).min(axis=1)
            best = int(worst.argmax())
            if worst[best] < now + 0.1:
                break
            points[node], now, moved = tried[best], float(worst[best]), True
            corners[own] = tried[best]
    return moved
