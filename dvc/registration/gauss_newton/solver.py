"""Conjugate gradients for a Gauss-Newton step, preconditioned on control grids of several spacings.

A control point's own block, of all its coefficients, tells a solver how far that point alone would go. It says nothing
of waves over many of them, which then take hundreds of iterations. But cubic B-splines on a grid with points twice as
far apart are among those of the finer grid: what their own blocks tell is added, grid by grid, each with less weight as
they overlap (Bramble, Pasciak and Xu, Math. Comp. 1990, doi:10.1090/S0025-5718-1990-1023042-6).
"""

from collections.abc import Callable, Sequence

import numpy as np

from dvc.arrays import FloatArray
from dvc.compiled import njit
from dvc.registration.gauss_newton.coarser_grids import onto_coarser, onto_finer
from dvc.threads import SMALL, in_parts

_AT_ONCE = 512  # control points, whose numbers stay in the cache
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

    Blocks are symmetric matrices at each control point, positive definite: their upper triangles row by row,
    (n, mi, mj, mk). It is symmetric and positive definite too.
    """
    inverses = [_inverted(own) for own in diagonals]

    def preconditioned(force: FloatArray, grid: int = 0) -> FloatArray:
        out = _multiplied(inverses[grid], force)
        if grid + 1 < len(inverses):
            longer = onto_finer(preconditioned(onto_coarser(force), grid + 1), force.shape[1:])
            longer *= _SHARE
            out += longer
        return out

    return preconditioned


def _inverted(blocks: FloatArray) -> FloatArray:
    """Inverses of symmetric positive matrices (n, mi, mj, mk)."""
    out = np.empty(blocks.shape)
    in_parts(_inverses, blocks[0].size, *_in_a_line(blocks, out))
    return out


def _multiplied(blocks: FloatArray, force: FloatArray) -> FloatArray:
    """Products of symmetric matrices (n, mi, mj, mk) and vectors (m, mi, mj, mk) at each control point."""
    out = np.empty(force.shape)
    if out.size < SMALL:
        _times(0, out[0].size, *_in_a_line(blocks, force, out))
    else:
        in_parts(_times, out[0].size, *_in_a_line(blocks, force, out))
    return out


def _in_a_line(*fields: FloatArray) -> list[FloatArray]:
    """Fields (n, mi, mj, mk) as (n, control points); of those in C order, views."""
    return [np.ascontiguousarray(field).reshape(len(field), -1) for field in fields]


@njit(nogil=True, cache=True)
def _times(start: int, stop: int, blocks: FloatArray, force: FloatArray, out: FloatArray) -> None:
    """Of an upper triangle of n rows, row by row, entry (a, b) is number a n - a (a + 1) / 2 + b."""
    size = len(force)
    for first in range(start, stop, _AT_ONCE):
        last = min(first + _AT_ONCE, stop)
        for a in range(size):
            onto = out[a, first:last]
            onto[:] = 0.0
            for b in range(size):
                low, high = min(a, b), max(a, b)
                block, along = blocks[low * size - low * (low + 1) // 2 + high, first:last], force[b, first:last]
                for p in range(onto.size):
                    onto[p] += block[p] * along[p]


@njit(nogil=True, cache=True, error_model="numpy")  # a matrix that has no inverse gets one of NaN
def _inverses(start: int, stop: int, blocks: FloatArray, out: FloatArray) -> None:
    """By a Cholesky factor R, upper triangular, and its inverse: A = R^T R."""
    size = int(np.sqrt(2 * len(blocks)))
    R, inverse = np.empty((size, size)), np.zeros((size, size))
    for p in range(start, stop):
        n = 0
        for a in range(size):
            for b in range(a, size):
                rest = blocks[n, p]
                for c in range(a):
                    rest -= R[c, a] * R[c, b]
                R[a, b] = np.sqrt(rest) if a == b else rest / R[a, a]
                n += 1
        for b in range(size):
            inverse[b, b] = 1.0 / R[b, b]
            for a in range(b - 1, -1, -1):
                total = 0.0
                for c in range(a + 1, b + 1):
                    total += R[a, c] * inverse[c, b]
                inverse[a, b] = -total / R[a, a]
        n = 0
        for a in range(size):
            for b in range(a, size):
                total = 0.0
                for c in range(b, size):
                    total += inverse[a, c] * inverse[b, c]
                out[n, p] = total
                n += 1


def dot(a: FloatArray, b: FloatArray) -> float:
    """Inner product, summed in an order that does not depend on threads (as BLAS would)."""
    return float((a * b).sum())
