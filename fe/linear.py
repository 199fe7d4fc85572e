"""Direct solution of symmetric, indefinite systems; the only file that depends on the library.

The library is MKL's PARDISO on x86-64; elsewhere NGSolve's sparse Cholesky if it is installed, otherwise SciPy's
SuperLU. Factorisations take most of the time of a simulation. PARDISO therefore factorises in single precision, and a
factorisation is reused as long as that is faster; it then preconditions an iterative solution in double precision.
"""

import os
import platform
from contextlib import suppress
from ctypes import CDLL, POINTER, byref, c_int32, c_int64, c_void_p
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import linalg

from dvc.arrays import FloatArray, IntArray
from dvc.errors import MrstrainError

_MOST_STEPS = 10  # of the iterative method; takes as long as a factorisation on typical meshes
_FINE = 1e-8  # residual of a solution with the factors of the matrix itself
# PARDISO's defaults for this kind of matrix (counted from 1), which must all be set if one is changed: METIS, smallest
# pivots of 1e-8, neither scaling nor matching. Changed: (21) diagonal pivoting in place of Bunch-Kaufman pivots, and
# (28) single precision.
_IN_SINGLE = {1: 1, 2: 2, 8: 0, 10: 8, 11: 0, 13: 0, 21: 0, 28: 1}


class SingularError(MrstrainError, RuntimeError):
    """A matrix that cannot be factorised: a part of the model is free to move, or memory is short."""


@cache
def tell_where_mkl_is() -> None:
    """Set the variable that pypardiso reads; without it, each solver starts compilers and searches the environment.

    A value that the user has set stays; where the distribution does not list a library that loads, pypardiso searches.
    """
    with suppress(PackageNotFoundError):
        for file in files("mkl") or ():
            if "mkl_rt" in file.name:
                with suppress(OSError):
                    CDLL(path := str(Path(file.locate()).resolve()))
                    os.environ.setdefault("PYPARDISO_MKL_RT", path)


class _Pardiso:
    def __init__(self, indptr: IntArray, indices: IntArray, threads: int, rough: bool) -> None:
        tell_where_mkl_is()  # before the import, which makes a solver

        from pypardiso import PyPardisoSolver

        self.rough, self.size = rough, len(indptr) - 1
        self._kind = np.float32 if rough else np.float64
        self._pattern = [np.asarray(of + 1, dtype=np.int32) for of in (indptr, indices)]  # counted from 1
        self._values = np.empty(0, dtype=self._kind)
        self._solver = PyPardisoSolver(mtype=-2)  # real, symmetric, indefinite
        for number, value in _IN_SINGLE.items() if rough else ():
            self._solver.set_iparm(number, value)
        self._solver.libmkl.MKL_Set_Num_Threads(threads)
        self._analysed = False

    def factorise(self, data: FloatArray) -> None:
        self._values = np.ascontiguousarray(data, dtype=self._kind)
        empty = np.zeros(self.size, dtype=self._kind)
        for phase in (22,) if self._analysed else (11, 22):
            self._call(phase, empty)
        self._analysed = True

    def solve(self, right: FloatArray) -> FloatArray:
        size = float(np.abs(right).max()) or 1.0  # no force is too small for single precision
        solution = self._call(33, np.asarray(right / size, dtype=self._kind))
        return size * np.asarray(solution, dtype=np.float64)

    def _call(self, phase: int, right: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """As `PyPardisoSolver`, without a copy of the pattern at every call."""
        solution, error, one = np.zeros_like(right), c_int32(0), byref(c_int32(1))
        kind, which, size = (byref(c_int32(number)) for number in (self._solver.mtype, phase, self.size))
        ia, ja, perm, iparm = (
            of.ctypes.data_as(POINTER(c_int32)) for of in (*self._pattern, self._solver.perm, self._solver.iparm)
        )
        a, b, x = (of.ctypes.data_as(c_void_p) for of in (self._values, right, solution))
        self._solver._mkl_pardiso(
            self._solver.pt.ctypes.data_as(POINTER(c_int64)), one, one, kind, which, size, a, ia, ja, perm, one, iparm,
            byref(c_int32(0)), b, x, byref(error),
        )  # fmt: skip
        if error.value:
            raise SingularError(f"The system cannot be factorised (PARDISO, error {error.value}).")
        return solution

    def close(self) -> None:
        self._solver.free_memory(everything=True)


class _NGSolve:
    """L D L^T of the lower triangle without pivoting; ordered and analysed once."""

    rough = False

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        from ngsolve import la

        size = len(indptr) - 1
        columns = np.repeat(np.arange(size), np.diff(indptr))  # rows of the upper triangle
        counted = np.arange(len(indices), dtype=np.float64)
        self._matrix = la.SparseMatrixd.CreateFromCOO(indices.tolist(), columns.tolist(), counted.tolist(), size, size)
        self._values = self._matrix.AsVector().FV().NumPy()
        self._order = self._values.astype(np.int64)  # position of each entry in the library
        self._inverse: Any = None

    def factorise(self, data: FloatArray) -> None:
        self._values[:] = data[self._order]
        if self._inverse is None:
            self._inverse = self._matrix.Inverse(inverse="sparsecholesky")
        else:
            self._inverse.Update()

    def solve(self, right: FloatArray) -> FloatArray:
        given, answer = self._matrix.CreateColVector(), self._matrix.CreateColVector()
        given.FV().NumPy()[:] = right
        answer.data = self._inverse * given
        solution = np.array(answer.FV().NumPy())
        if not np.isfinite(solution).all():
            raise SingularError("The system cannot be factorised (NGSolve: a pivot is zero).")
        return solution

    def close(self) -> None:
        self._inverse = None


class _SuperLU:
    rough = False

    def __init__(self, indptr: IntArray, indices: IntArray) -> None:
        self._upper = sparse.csr_matrix((np.ones(len(indices)), indices, indptr))
        self._factors: linalg.SuperLU | None = None

    def factorise(self, data: FloatArray) -> None:
        self._upper.data = np.ascontiguousarray(data)
        whole = self._upper + sparse.triu(self._upper, 1).T
        try:
            self._factors = linalg.splu(
                whole.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as failure:
            raise SingularError(f"The system cannot be factorised (SuperLU: {failure}).") from failure

    def solve(self, right: FloatArray) -> FloatArray:
        assert self._factors is not None
        return np.asarray(self._factors.solve(right))

    def close(self) -> None:
        self._factors = None


Factors = _Pardiso | _NGSolve | _SuperLU
"""A symmetric matrix of fixed pattern: `factorise` takes new values of its upper triangle, in the order of the pattern.
"""


def factors(
    indptr: IntArray, indices: IntArray, *, threads: int = 1, library: str | None = None, rough: bool = False
) -> Factors:
    """A solver for symmetric matrices whose upper triangle has this pattern (CSR, sorted, with its whole diagonal).

    ``threads`` and ``rough`` (single precision) apply to PARDISO; ``library`` is by default the fastest available.
    """
    if (chosen := library or _fastest()) == "pardiso":
        return _Pardiso(indptr, indices, threads, rough)
    return _NGSolve(indptr, indices) if chosen == "ngsolve" else _SuperLU(indptr, indices)


def _fastest() -> str:
    if platform.machine().lower() in ("x86_64", "amd64"):
        return "pardiso"
    return "ngsolve" if find_spec("ngsolve") else "superlu"


def self_test() -> str:
    """Solve a small system; return a sentence with the result, for `mrstrain doctor`."""
    A = sparse.diags([4.0, -1.0], [0, 1], shape=(100, 100), format="csr")
    A.sort_indices()
    solver = factors(A.indptr.astype(np.int64), A.indices.astype(np.int64))
    solver.factorise(A.data)
    x = solver.solve(np.ones(100))
    solver.close()
    whole = A + sparse.triu(A, 1).T
    if np.abs(whole @ x - 1.0).max() > _FINE:
        raise MrstrainError(f"{_fastest()} gave a wrong solution of a hundred equations.")
    return f"{_fastest()} solved a hundred equations"


class Solver:
    """Solves systems whose matrix changes little from one to the next; ``factorisations`` and ``steps`` count the work.

    It uses the generalised conjugate residual method (Eisenstat, Elman, Schultz 1983, doi:10.1137/0720023),
    preconditioned by the last factorised matrix. If it converges too slowly, the current matrix is factorised in single
    precision. If that is not enough, double precision is used until `forget` is called.
    """

    def __init__(self, indptr: IntArray, indices: IntArray, *, threads: int = 1) -> None:
        self._new = partial(factors, indptr, indices, threads=threads)
        self._factors = self._new(rough=True)
        self._began_rough = self._factors.rough
        self._upper = sparse.csr_matrix((np.ones(len(indices)), indices, indptr))
        self._diagonal = indptr[:-1]  # the first entry of each row
        self._known = False
        self.factorisations, self.steps = 0, 0

    def solve(self, data: FloatArray, right: FloatArray, tolerance: float) -> FloatArray:
        """Solve to a relative residual below ``tolerance``, or below 1e-8 if a factorisation is needed."""
        if self._known and (solution := self._iterated(data, right, tolerance)) is not None:
            return solution
        if self._factors.rough:
            with suppress(SingularError):
                self._factorise(data)
                if (solution := self._iterated(data, right, _FINE)) is not None:
                    return solution
            self._renew(rough=False)
        self._factorise(data)
        return self._factors.solve(right)

    def _renew(self, *, rough: bool) -> None:
        self._known = False
        self._factors.close()
        self._factors = self._new(rough=rough)

    def _factorise(self, data: FloatArray) -> None:
        self._known = False  # the old factors are gone even if this fails
        self._factors.factorise(data)
        self._known = True
        self.factorisations += 1

    def forget(self) -> None:
        """Factorise at the next solution, so that it does not depend on earlier ones."""
        self._known = False
        if self._began_rough and not self._factors.rough:
            self._renew(rough=True)

    def _iterated(self, data: FloatArray, right: FloatArray, tolerance: float) -> FloatArray | None:
        self._upper.data = np.ascontiguousarray(data)
        diagonal = data[self._diagonal]
        x, residual = np.zeros_like(right), right.copy()
        first = float(np.linalg.norm(right))
        if first == 0.0:
            return x
        directions: list[tuple[FloatArray, FloatArray]] = []
        for step in range(1, _MOST_STEPS + 1):
            p = self._factors.solve(residual)
            q = self._upper @ p + self._upper.T @ p - diagonal * p
            for other_p, other_q in directions:
                share = float(q @ other_q)
                p, q = p - share * other_p, q - share * other_q
            length = float(np.linalg.norm(q))
            if not np.isfinite(length) or length == 0.0:
                return None
            p, q = p / length, q / length
            directions.append((p, q))
            share = float(residual @ q)
            x, residual = x + share * p, residual - share * q
            self.steps += 1
            left = float(np.linalg.norm(residual)) / first
            if left <= tolerance:
                return x
            # Would it converge at this rate?
            if left >= 1.0 or step * np.log(tolerance) / np.log(left) > _MOST_STEPS:
                return None
        return None

    def close(self) -> None:
        """Free the memory."""
        self._factors.close()
