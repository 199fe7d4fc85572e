"""Residual and tangent of a mixed finite-element model, assembled into one symmetric sparse matrix (numba kernels).

Unknowns are the displacements of the nodes (three each, mm), then the pressures (MPa). A free unknown has its own
equation, a fixed one has none, and nodes taped to a rigid plate share equations. The sparsity pattern is computed once,
for all nodes that may be taped.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.compiled import njit
from dvc.threads import in_parts
from fe.elements import CROWDED, Model
from fe.hyperelastic import principal_response, singular_values

_CHUNK = 4096  # cells whose matrices are in memory at once
_FEW = 0.1  # fraction of the unknowns up to which it is faster to evaluate the cells around them twice than all once


@dataclass(frozen=True, slots=True, eq=False)
class _Evaluated:
    """Forces at a state, by unknown, and the tangent's values for these equations if they were computed."""

    state: FloatArray
    forces: FloatArray
    lowest: FloatArray  # (cells,) least det F
    tangent: FloatArray | None
    equation: IntArray


class Assembler:
    """The sparse system of a model under changing constraints; unknowns in ``fixed`` (f,) never change.

    ``shared`` maps each shared equation, numbered from 0, to all unknowns that may follow it.
    """

    def __init__(self, model: Model, fixed: IntArray, shared: Mapping[int, IntArray]) -> None:
        # Cells with the same nodes follow one another, so that what they add to is still in the cache.
        self.model = model = model.in_order(np.argsort(model.space.cells.min(axis=1), kind="stable"))
        self._cells = model.unknowns_of_cells()
        self._nodes = model.space.cells
        free = np.ones(model.unknowns, dtype=bool)
        free[fixed] = False
        self._own = np.where(free, np.cumsum(free) - 1, -1)  # -1 where fixed
        self.own_equations = int(free.sum())
        self.size = self.own_equations + len(shared)
        self.indptr, self.indices = self._pattern(shared)
        columns = [np.flatnonzero(self.indices == self.own_equations + n)[:-1] for n in range(len(shared))]
        self._columns = [(column, np.searchsorted(self.indptr, column, side="right") - 1) for column in columns]
        self.equation = self._own
        self._places = self._located(np.arange(len(self._cells)), self.equation)
        self.forget()

    def share(self, followers: Mapping[int, IntArray]) -> None:
        """Let unknowns follow shared equations (numbered as in the constructor); all others keep their own."""
        equation = self._own.copy()
        for number, unknowns in followers.items():
            equation[unknowns] = self.own_equations + number
        if (changed := equation != self.equation).any():
            self.equation = equation
            cells = self._around(changed)
            self._places[cells] = self._located(cells, equation)

    def forget(self) -> None:
        """Evaluate the next state completely, so that it does not depend on earlier states, not even by rounding."""
        self._last = _Evaluated(np.empty(0), np.empty(0), np.empty(0), None, self.equation)

    def _around(self, unknowns: BoolArray) -> IntArray:
        """Cells that have one of these unknowns."""
        return np.flatnonzero(unknowns[self._cells].any(axis=1))

    def _located(self, cells: IntArray, equation: IntArray) -> IntArray:
        """Positions (cells, pairs) in the upper triangle to which cells add their tangents; see `_locate`."""
        width = self._cells.shape[1]
        places = np.empty((len(cells), width * (width + 1) // 2), dtype=np.int32)
        in_parts(_locate, len(cells), self._cells[cells], equation, self.indptr, self.indices, places)
        return places

    @property
    def force_equations(self) -> BoolArray:
        """Which equations balance forces, (size,); the others relate volume to pressure."""
        forces = np.ones(self.size, dtype=bool)
        pressures = self.equation[3 * len(self.model.space.nodes_mm) :]
        forces[pressures[pressures >= 0]] = False
        return forces

    @property
    def idle(self) -> IntArray:
        """Equations without an unknown at present; their diagonal is 1 and their residual 0."""
        used = np.zeros(self.size, dtype=bool)
        used[self.equation[self.equation >= 0]] = True
        return np.flatnonzero(~used)

    def residual(self, state: FloatArray, *, ahead: bool = False) -> tuple[FloatArray, FloatArray, float]:
        """Forces (N; for pressures mm3) by unknown and by equation, and the smallest det F; NaN where det F <= 0.

        ``ahead`` computes the tangent in the same sweep, which is faster if it is needed next.
        """
        if not np.array_equal(state, self._last.state):
            if found := self._corrected(state) if ahead else None:
                self._last = found
            else:
                self.forget()  # frees its tangent before there is another
                self._last = self._evaluated(state, ahead=ahead)
        by_unknown = self._last.forces.copy()
        return by_unknown, self.by_equation(by_unknown), float(self._last.lowest.min())

    def tangent(self, state: FloatArray) -> FloatArray:
        """Values of the upper triangle of the tangent, in the order of `indices`."""
        last = self._last
        if last.tangent is None or last.equation is not self.equation or not np.array_equal(state, last.state):
            last = self._evaluated(state, ahead=True)
        assert last.tangent is not None
        data = last.tangent.copy()
        data[self.indptr[self.idle]] = 1.0  # the diagonal is the first entry of each row
        return data

    def hold(self, data: FloatArray, right: FloatArray, equations: IntArray, moves: FloatArray) -> None:
        """Prescribe moves of shared equations: their diagonal is 1, their columns go to the right-hand side."""
        for equation, move in zip(equations, moves, strict=True):
            column, rows = self._columns[equation - self.own_equations]
            right[rows] -= data[column] * move
            row = slice(self.indptr[equation], self.indptr[equation + 1])
            right[self.indices[row][1:]] -= data[row][1:] * move
            data[column], data[row] = 0.0, 0.0
            data[self.indptr[equation]] = 1.0
        right[equations] = moves

    def spread(self, change: FloatArray) -> FloatArray:
        """Change of every unknown from that of every equation; 0 where fixed."""
        return np.where(self.equation >= 0, change[self.equation], 0.0)

    def by_equation(self, by_unknown: FloatArray) -> FloatArray:
        """Sum of a quantity of the unknowns over each equation."""
        inside = self.equation >= 0
        return np.bincount(self.equation[inside], by_unknown[inside], self.size).astype(np.float64)

    def acting(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """The tangent times directions (unknowns, k), by unknown, as if each unknown had its own equation."""
        product = np.zeros_like(directions)
        cells = np.flatnonzero((directions != 0.0).any(axis=1)[self._cells].any(axis=1))
        for part, _, local, _ in self._in_chunks(state, cells, with_tangent=True):
            _add_products(self._cells[part], local, directions, product)
        return product

    def _evaluated(self, state: FloatArray, *, ahead: bool) -> _Evaluated:
        """Forces of all cells at a state and, with ``ahead``, the tangent."""
        tangent = np.zeros(len(self.indices)) if ahead else None
        found = _Evaluated(
            state.copy(), np.zeros(self.model.unknowns), np.empty(len(self._cells)), tangent, self.equation
        )
        self._add(found, state, None, self._places)
        return found

    def _corrected(self, state: FloatArray) -> _Evaluated | None:
        """The last evaluation, updated in the cells around the few unknowns that changed; None if too many changed."""
        last = self._last
        if last.tangent is None or not last.lowest.min() > 0.0:
            return None
        other = (state != last.state) | (self.equation != last.equation)
        if np.count_nonzero(other) > _FEW * len(other):
            return None
        found = _Evaluated(state.copy(), last.forces, last.lowest, last.tangent, self.equation)
        cells = self._around(other)
        self._add(found, last.state, cells, self._located(cells, last.equation), sign=-1.0)
        self._add(found, state, cells, self._places[cells])
        return found

    def _add(
        self, found: _Evaluated, state: FloatArray, cells: IntArray | None, places: IntArray, *, sign: float = 1.0
    ) -> None:  # fmt: skip
        """Add the contributions of cells (None: all) at a state to ``places``, given in the order of the cells."""
        done = 0
        for part, forces, tangents, lowest in self._in_chunks(state, cells, with_tangent=found.tangent is not None):
            _add_forces(self._cells[part], sign, forces, found.forces)
            found.lowest[part] = lowest
            if found.tangent is not None:
                _add_tangents(places[done : done + len(lowest)], sign, tangents, found.tangent)
            done += len(lowest)

    def _in_chunks(
        self, state: FloatArray, cells: IntArray | None, *, with_tangent: bool
    ) -> Iterator[tuple[slice | IntArray, FloatArray, FloatArray, FloatArray]]:
        """Forces, tangents (upper triangles) and smallest det F of cells (None: all), `_CHUNK` at a time."""
        m, space, element = self.model, self.model.space, self.model.element
        count = 3 * len(space.nodes_mm)
        u = np.ascontiguousarray(state[:count].reshape(-1, 3))
        p = np.ascontiguousarray(state[count:])
        forces = np.empty((_CHUNK, self._cells.shape[1]))
        width = self._cells.shape[1]
        tangents = np.empty((_CHUNK if with_tangent else 1, width * (width + 1) // 2))
        volumes = np.empty(_CHUNK)
        total = len(self._cells) if cells is None else len(cells)
        for start in range(0, total, _CHUNK):
            stop = min(start + _CHUNK, total)
            part = slice(start, stop) if cells is None else cells[start:stop]
            in_parts(
                _elements, stop - start, self._nodes[part], space.pressure_cells[part], m.volumes_mm3[part],
                m.inverse[part], m.law[part], m.vectors, m.shear_mpa, m.bulk_mpa, m.own_bulk_mpa, element.weights,
                element.gradients, element.pressure, element.stabilisation, u, p, with_tangent, forces, tangents,
                volumes,
            )  # fmt: skip
            yield part, forces, tangents, volumes[: stop - start]

    def _pattern(self, shared: Mapping[int, IntArray]) -> tuple[IntArray, IntArray]:
        """Upper triangle: equations of unknowns that share a cell, and shared equations with all possible followers."""
        count, width = self._cells.shape
        cell = np.repeat(np.arange(count), width)
        meets = sparse.csr_matrix((np.ones(cell.size, dtype=np.int32), (cell, self._cells.ravel())))
        rows = [self._own, *(np.full(len(unknowns), self.own_equations + n) for n, unknowns in shared.items())]
        row, column = np.concatenate(rows), np.concatenate([np.arange(self.model.unknowns), *shared.values()])
        kept = row >= 0
        entries = np.ones(kept.sum(), dtype=np.int32), (row[kept], column[kept])
        touches = sparse.csr_matrix(entries, shape=(self.size, self.model.unknowns)) @ meets.T
        coupled = sparse.triu(touches @ touches.T + sparse.identity(self.size, dtype=np.int32), format="csr")
        coupled.sort_indices()
        return coupled.indptr.astype(np.int32), coupled.indices.astype(np.int32)


@njit(nogil=True, cache=True)
def _locate(
    start: int, stop: int, cells: IntArray, equation: IntArray, indptr: IntArray, indices: IntArray, places: IntArray
) -> None:  # fmt: skip
    """Position in the upper triangle of each pair of a cell's unknowns; -1: one is fixed; -2 - position: add twice."""
    width = cells.shape[1]
    for cell in range(start, stop):
        pair = 0
        for i in range(width):
            for j in range(i, width):
                row, column = equation[cells[cell, i]], equation[cells[cell, j]]
                place = -1
                if row >= 0 and column >= 0:
                    if row > column:
                        row, column = column, row
                    low, high = indptr[row], indptr[row + 1] - 1
                    while low < high:
                        middle = (low + high) // 2
                        if indices[middle] < column:
                            low = middle + 1
                        else:
                            high = middle
                    # Two unknowns of one equation: both entries of the symmetric pair are on its diagonal.
                    place = low if row < column or i == j else -2 - low
                places[cell, pair] = place
                pair += 1


@njit(cache=True)
def _add_forces(cells: IntArray, sign: float, local: FloatArray, forces: FloatArray) -> None:
    for n in range(len(cells)):
        for i in range(cells.shape[1]):
            forces[cells[n, i]] += sign * local[n, i]


@njit(cache=True)
def _add_tangents(places: IntArray, sign: float, local: FloatArray, data: FloatArray) -> None:
    for n in range(len(places)):
        for pair in range(places.shape[1]):
            place = places[n, pair]
            if place >= 0:
                data[place] += sign * local[n, pair]
            elif place < -1:
                data[-2 - place] += 2.0 * sign * local[n, pair]


@njit(cache=True)
def _add_products(cells: IntArray, local: FloatArray, directions: FloatArray, product: FloatArray) -> None:
    width = cells.shape[1]
    for n in range(len(cells)):
        pair = 0
        for i in range(width):
            for j in range(i, width):
                for k in range(directions.shape[1]):
                    product[cells[n, i], k] += local[n, pair] * directions[cells[n, j], k]
                    if j > i:
                        product[cells[n, j], k] += local[n, pair] * directions[cells[n, i], k]
                pair += 1


@njit(inline="always", error_model="numpy")
def _add_stiffness(
    K: FloatArray, weight: float, h: FloatArray, U: FloatArray, direct: FloatArray, swapped: FloatArray
) -> None:  # fmt: skip
    """Add the stiffness of a cell at one quadrature point, from gradients in the principal frame."""
    D, T, M = direct, swapped[:, :, 1], swapped[:, :, 0]
    for a in range(len(h)):
        x, y, z = weight * h[a, 0], weight * h[a, 1], weight * h[a, 2]
        for b in range(a, len(h)):
            p, q, r = h[b, 0], h[b, 1], h[b, 2]
            xx = D[0, 0] * x * p + D[0, 1] * y * q + D[0, 2] * z * r
            yy = D[1, 0] * x * p + D[1, 1] * y * q + D[1, 2] * z * r
            zz = D[2, 0] * x * p + D[2, 1] * y * q + D[2, 2] * z * r
            xy, yx = M[0, 1] * x * q + T[0, 1] * y * p, M[0, 1] * y * p + T[0, 1] * x * q
            xz, zx = M[0, 2] * x * r + T[0, 2] * z * p, M[0, 2] * z * p + T[0, 2] * x * r
            yz, zy = M[1, 2] * y * r + T[1, 2] * z * q, M[1, 2] * z * q + T[1, 2] * y * r
            for k in range(3):
                along = xx * U[k, 0] + xy * U[k, 1] + xz * U[k, 2]
                across = yx * U[k, 0] + yy * U[k, 1] + yz * U[k, 2]
                third = zx * U[k, 0] + zy * U[k, 1] + zz * U[k, 2]
                for i in range(3):
                    K[3 * a + i, 3 * b + k] += U[i, 0] * along + U[i, 1] * across + U[i, 2] * third


@njit(inline="always", error_model="numpy")
def _deform(
    F: FloatArray, g: FloatArray, n: int, q: int, cells: IntArray, inverse: FloatArray, tables: FloatArray,
    u: FloatArray,
) -> None:  # fmt: skip
    """Write the gradients of the displacement functions and F at one quadrature point of a cell."""
    for i in range(3):
        for j in range(3):
            F[i, j] = 1.0 if i == j else 0.0
    for a in range(len(g)):
        for j in range(3):
            g[a, j] = (
                tables[q, a, 0] * inverse[n, 0, j]
                + tables[q, a, 1] * inverse[n, 1, j]
                + tables[q, a, 2] * inverse[n, 2, j]
            )
            for i in range(3):
                F[i, j] += u[cells[n, a], i] * g[a, j]


@njit(nogil=True, cache=True, error_model="numpy")
def _elements(
    first: int, last: int,
    cells: IntArray, pressure_cells: IntArray, volumes: FloatArray, inverse: FloatArray, law: IntArray,
    vectors: FloatArray, shear: FloatArray, bulk: FloatArray, own: FloatArray,
    weights: FloatArray, tables: FloatArray, pressure: FloatArray, tau: float, u: FloatArray, p: FloatArray,
    with_tangent: bool, forces: FloatArray, tangents: FloatArray, lowest: FloatArray,
) -> None:  # fmt: skip
    """Forces and tangents of cells, and the smallest det F at the quadrature points of each."""
    points, nodes, width = tables.shape[0], tables.shape[1], 3 * tables.shape[1] + 4
    g, h = np.empty((nodes, 3)), np.empty((nodes, 3))
    F, U, V, s = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    stress, direct, swapped = np.empty(3), np.empty((3, 3)), np.zeros((3, 3, 2))
    K, f = np.empty((width, width)), np.empty(width)
    for n in range(first, last):
        f[:] = 0.0
        if with_tangent:
            K[:, :] = 0.0
        which = law[n]
        lowest[n] = np.inf
        for q in range(points):
            weight = weights[q] * volumes[n]
            _deform(F, g, n, q, cells, inverse, tables, u)
            pq = 0.0
            for c in range(4):
                pq += pressure[q, c] * p[pressure_cells[n, c]]
            J = singular_values(F, U, s, V)
            lowest[n] = min(lowest[n], J)
            if not J > 0.0:
                f[:] = np.nan
                break
            pq += own[which] * (J - 1.0)
            rise = own[which]
            if J < CROWDED:
                depth = np.log(CROWDED / J)
                pq -= bulk[which] * depth**2 / J
                rise += bulk[which] * (2.0 + depth) * depth / J**2
            principal_response(vectors[which], s, J, pq, rise, stress, direct, swapped)
            for a in range(nodes):  # gradients in the principal frame
                for j in range(3):
                    h[a, j] = g[a, 0] * V[0, j] + g[a, 1] * V[1, j] + g[a, 2] * V[2, j]
            for a in range(nodes):
                for i in range(3):
                    value = 0.0
                    for k in range(3):
                        value += U[i, k] * stress[k] * h[a, k]
                    f[3 * a + i] += weight * value
            for c in range(4):
                f[3 * nodes + c] += weight * pressure[q, c] * (J - 1.0)
            if not with_tangent:
                continue
            _add_stiffness(K, weight, h, U, direct, swapped)
            for a in range(nodes):
                for i in range(3):
                    value = 0.0
                    for k in range(3):
                        value += U[i, k] * h[a, k] / s[k]
                    for c in range(4):
                        K[3 * a + i, 3 * nodes + c] += weight * J * value * pressure[q, c]
        # Pressure-pressure block: mass matrix over the bulk modulus, and the stabilisation.
        for c in range(4):
            for d in range(4):
                mass = volumes[n] / 20.0 * (2.0 if c == d else 1.0)
                value = mass / (bulk[which] - own[which]) + tau / shear[which] * (mass - volumes[n] / 16.0)
                f[3 * nodes + c] -= value * p[pressure_cells[n, d]]
                K[3 * nodes + c, 3 * nodes + d] -= value
        forces[n, :] = f
        if with_tangent:
            pair = 0
            for i in range(width):
                for j in range(i, width):
                    tangents[n, pair] = K[i, j]
                    pair += 1
