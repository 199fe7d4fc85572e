"""Conjugate gradients for a Gauss-Newton step, preconditioned on control grids of several spacings.

A control point's own 3 x 3 block tells a solver how far that point alone would go. It says nothing of waves over many
of them, which then take hundreds of iterations. But cubic B-splines on a grid with points twice as far apart are among
those of the finer grid: what their own blocks tell is added, grid by grid, each with less weight as they overlap
(Bramble, Pasciak and Xu, Math. Comp. 1990, doi:10.1090/S0025-5718-1990-1023042-6).
"""

from collections.abc import Callable, Sequence

import numpy as np

from dvc.arrays import FloatArray
from dvc.registration.gauss_newton.coarser_grids import onto_coarser, onto_finer

_SHARE = 0.4  # of what the coarser grid's blocks tell

Preconditioner = Callable[[FloatArray], FloatArray]


def conjugate_gradients(
    product: Callable[[FloatArray], FloatArray], force: FloatArray, preconditioned: Preconditioner, tolerance: float,
    most: int,
) -> FloatArray:  # fmt: skip
    """Solve A x = force for a symmetric, positive definite A, given by its product with x.

    Ends once the residual's preconditioned norm is `tolerance` times what it was, or after the `most` iterations.
    """
    x, left, scaled = np.zeros_like(force), force.copy(), np.empty_like(force)
    weighted = preconditioned(left)
    along, norm = weighted.copy(), dot(left, weighted)
    enough = tolerance**2 * norm
    for _ in range(most):
        if norm <= enough:
            break
        pushed = product(along)
        length = norm / dot(along, pushed)
        x += np.multiply(length, along, out=scaled)
        left -= np.multiply(length, pushed, out=scaled)
        weighted = preconditioned(left)
        before, norm = norm, dot(left, weighted)
        along *= norm / before
        along += weighted
    return x


def by_blocks(diagonals: Sequence[FloatArray]) -> Preconditioner:
    """The preconditioner from each grid's own blocks, finest first.

    Blocks are (6 splines, mi, mj, mk), symmetric 3 x 3 matrices xx, xy, xz, yy, yz, zz at each control point, positive
    definite. It is symmetric and positive definite too.
    """
    inverses = [np.concatenate([_inverted(own) for own in np.split(d, len(d) // 6)]) for d in diagonals]

    def preconditioned(force: FloatArray, grid: int = 0) -> FloatArray:
        out = _times(inverses[grid], force)
        if grid + 1 < len(inverses):
            longer = onto_finer(preconditioned(onto_coarser(force), grid + 1), force.shape[1:])
            longer *= _SHARE
            out += longer
        return out

    return preconditioned


def with_local_jump(preconditioned: Preconditioner, reach_mm: float) -> Preconditioner:
    """The preconditioner for the splines v and w of u = m v + psi w, from one for v + L w and w.

    Beyond the reach L of an interface, psi is L m: v and w move tissue alike there, and the own blocks of one know
    nothing of the other. Beside v + L w, the factor of w is psi - L m, which is zero there. Coefficients are those of
    v, mm, and then of w, (6, mi, mj, mk); L is in mm.
    """

    def local(force: FloatArray) -> FloatArray:
        given = force.copy()
        given[3:] -= reach_mm * force[:3]
        out = preconditioned(given)
        out[:3] -= reach_mm * out[3:]
        return out

    return local


def _times(blocks: FloatArray, force: FloatArray) -> FloatArray:
    out = np.empty_like(force)
    for n in range(len(force) // 3):
        xx, xy, xz, yy, yz, zz = blocks[6 * n : 6 * n + 6]
        x, y, z = force[3 * n : 3 * n + 3]
        out[3 * n] = xx * x + xy * y + xz * z
        out[3 * n + 1] = xy * x + yy * y + yz * z
        out[3 * n + 2] = xz * x + yz * y + zz * z
    return out


def _inverted(blocks: FloatArray) -> FloatArray:
    """Inverses of symmetric positive 3 x 3 matrices (6, ...)."""
    xx, xy, xz, yy, yz, zz = blocks
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    found = np.stack([a, b, c, xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy])
    return np.asarray(found / (xx * a + xy * b + xz * c))


def dot(a: FloatArray, b: FloatArray) -> float:
    """Inner product, summed in an order that does not depend on threads (as BLAS would)."""
    return float((a * b).sum())
