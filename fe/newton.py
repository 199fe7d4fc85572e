"""Newton's method for one load increment, with step lengths at which no cell folds."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dvc.arrays import FloatArray, IntArray
from fe.assembly import Assembler
from fe.linear import SingularError, Solver
from fe.plate import Parallel

_LEAST_SHARE = 1.0 / 256.0
_NEAR = 0.02  # residual, as a fraction of the support forces, below which contact is updated
LEAST_VOLUME = 0.002  # lower bound on det F at the quadrature points in any step: below it a cell is about to fold
_MOST_GROWTH = 3.0  # of the residual in one step
# Consecutive steps that hardly lowered the residual, from which on several step lengths are tried; and steps within
# which it must fall to half of what it was when it last did so, or the search stops (unless it is nearly converged).
_WANDERED, _LOST = 2, 12
BALANCED, SMALL_MM = 5, 0.1  # also converged: so many consecutive steps within the force tolerance, the last this small
_LINGERED, _CLOSE, _CLOSEST = 8, 10.0, 1e-3  # or so many within so many times the tolerance, at most this fraction
_SHARES = (1.0, 0.5, 0.25)
_ROUGH, _INEXACT = 0.05, 1e-3  # tolerance of the linear solver, far from equilibrium and near it


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Convergence criterion of an increment.

    Attributes
    ----------
    force : float
        Largest norm of the residual forces, as a fraction of the forces on the plate and the fixed nodes.
    step_mm : float
        Largest change of a displacement in the last step, mm. Five consecutive steps within ``force``, or eight within
        ten times it (at most .1 %), the last below 0.1 mm, are also accepted, because the nodes of a nearly flat cell
        may move almost without force.
    iterations : int
        Largest number of iterations; at most 15 below half of the normal load with a material that is far from every
        published one. A search ends earlier if the residual does not halve within 12 iterations.
    """

    force: float = 1e-4
    step_mm: float = 1e-3
    iterations: int = 40


@dataclass(frozen=True, slots=True, eq=False)
class Converged:
    """A state in equilibrium."""

    state: FloatArray  # (unknowns,)
    forces: FloatArray  # (unknowns,) internal, N
    iterations: int


@dataclass(frozen=True, slots=True, eq=False)
class Imposed:
    """External forces and prescribed displacements of an increment."""

    forces_n: FloatArray  # (equations,) external forces
    prescribed: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (h,) equations
    moves_mm: FloatArray = field(default_factory=lambda: np.empty(0))  # (h,) prescribed changes from the first guess


def equilibrium(
    assembler: Assembler, solver: Solver, state: FloatArray, imposed: Imposed, tolerance: Tolerance,
    changed: Callable[[FloatArray, FloatArray], bool] = lambda _state, _forces: False,
    log: Callable[[str], None] = lambda _: None, rotation: Parallel | None = None,
) -> Converged | None:  # fmt: skip
    """Find the state in which internal forces balance the external ones, from a first guess (unknowns,).

    ``changed(state, forces)`` is called near equilibrium and again at equilibrium. It returns whether the constraints
    of the unknowns have changed, for example because more of a surface touches the plate, and may adapt the state to
    them. Without ``rotation`` the plate stays parallel. None if the iteration does not converge; if only forces are
    prescribed, `fe.descent` may still converge.
    """
    newton = _Newton(assembler, solver, imposed, rotation or Parallel())
    displacements = 3 * len(assembler.model.space.nodes_mm)
    now, left = newton.at(state.copy()), imposed.moves_mm.copy()
    if not now.lowest > 0.0:
        return None
    wandering, stalled, balanced, close, balance, halved = 0, 0, 0, 0, 0.0, np.inf
    for iteration in range(1, tolerance.iterations + 1):
        try:
            step = newton.step(now, left, _ROUGH if balance > _NEAR else _INEXACT)
        except SingularError as failure:
            log(f"    {failure}")
            return None
        bound = np.inf if left.any() or iteration == 1 else _MOST_GROWTH * now.unbalanced_n
        before, now, share = now, *newton.searched(now, step, bound, several=wandering >= _WANDERED)
        if not share:
            return None
        largest = float(np.abs((now.state - before.state)[:displacements]).max())
        left = (1.0 - share) * left
        balance = now.unbalanced_n / max(reaction(assembler, now.forces), 1e-9)
        slow = now.unbalanced_n > 0.5 * before.unbalanced_n and balance > tolerance.force
        wandering = wandering + 1 if slow else 0
        stays = now.unbalanced_n > 0.5 * halved and not left.any()
        stalled, halved = (stalled + 1, halved) if stays else (0, now.unbalanced_n)
        log(f"    {iteration}: residual {balance:.1e}, step {largest:.1e} mm, smallest det F {now.lowest:.3f}")
        near = balance <= max(tolerance.force, min(_CLOSE * tolerance.force, _CLOSEST))
        if (stalled >= _LOST and not near) or (wandering >= _LOST and left.any()):
            return None
        if left.any() or balance > _NEAR:
            close = 0
            continue
        if changed(now.state, now.forces):
            now, balanced, close = newton.at(now.state), 0, 0
            continue
        balanced = balanced + 1 if balance <= tolerance.force else 0
        close = close + 1 if near else 0
        if balanced and share == 1.0 and largest <= tolerance.step_mm:
            return Converged(now.state, now.forces, iteration)
        if (balanced >= BALANCED or close >= _LINGERED) and largest <= share * SMALL_MM:
            within = f"{balanced} consecutive steps within" if balanced >= BALANCED else f"{close} within ten times"
            log(f"    accepted: {within} the force tolerance, the last of {largest:.1e} mm")
            return Converged(now.state, now.forces, iteration)
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Iterate:
    """An iterate: the state, its forces by unknown and by equation, the smallest det F, and the residual norm."""

    state: FloatArray
    forces: FloatArray
    residual: FloatArray
    lowest: float
    unbalanced_n: float


@dataclass(frozen=True, slots=True, eq=False)
class _Newton:
    """Newton steps of one increment: the change of all unknowns, and the rotation of the plate (3,)."""

    assembler: Assembler
    solver: Solver
    imposed: Imposed
    rotation: Parallel

    def at(self, state: FloatArray) -> _Iterate:
        forces, residual, lowest = self.assembler.residual(state, ahead=True)
        of_forces = out_of_balance(self.imposed.forces_n - residual, self.assembler, self.imposed.prescribed)
        of_moment = self.rotation.missing_n(state, forces)
        return _Iterate(state, forces, residual, lowest, float(np.hypot(of_forces, of_moment)))

    def step(self, now: _Iterate, left_mm: FloatArray, accuracy: float) -> tuple[FloatArray, FloatArray]:
        """The step from an iterate; ``left_mm`` (h,) is the rest of the prescribed changes."""
        held = self.imposed.prescribed
        right = self.imposed.forces_n - now.residual
        right[self.assembler.idle] = 0.0
        data = self.assembler.tangent(now.state)
        self.assembler.hold(data, right, held, left_mm)
        level = self.solver.solve(data, right, accuracy)
        solved, turn = self.rotation.solved(now.state, now.forces, data, level, held)
        solved[held] = left_mm  # exact even if the linear solution is approximate
        change = self.assembler.spread(solved)
        if not np.isfinite(change).all():
            raise SingularError("The linear solution is not finite.")
        return change, turn

    def ahead(self, now: _Iterate, step: tuple[FloatArray, FloatArray], share: float) -> _Iterate:
        """The iterate after a fraction of a step."""
        change, turn = step
        return self.at(self.rotation.ahead(now.state, share * change, share * turn))

    def searched(
        self, now: _Iterate, step: tuple[FloatArray, FloatArray], bound_n: float, *, several: bool
    ) -> tuple[_Iterate, float]:
        """The iterate after a step that is halved until no cell folds and the bound holds, and the fraction; 0 if none.

        The first fraction is 1 or, with ``several``, the one of 1, 1/2 and 1/4 with the smallest residual.
        """
        share = 1.0
        if several:
            tries = {share: self.ahead(now, step, share) for share in _SHARES}
            share = min(tries, key=lambda s: tries[s].unbalanced_n if tries[s].lowest > LEAST_VOLUME else np.inf)
        while share >= _LEAST_SHARE:
            tried = self.ahead(now, step, share)
            if tried.lowest > LEAST_VOLUME and tried.unbalanced_n <= bound_n:
                return tried, share
            share *= 0.5
        return now, 0.0


def out_of_balance(unbalanced: FloatArray, assembler: Assembler, prescribed: IntArray | None = None) -> float:
    """Norm of the residual forces by equation (N), without those of prescribed unknowns."""
    balance = unbalanced.copy()
    balance[assembler.idle] = 0.0
    if prescribed is not None:
        balance[prescribed] = 0.0
    return float(np.linalg.norm(balance[assembler.force_equations]))


def reaction(assembler: Assembler, forces: FloatArray) -> float:
    """Norm of the force on fixed nodes and shared equations, N."""
    carried = (assembler.equation < 0) | (assembler.equation >= assembler.own_equations)
    return float(np.linalg.norm(forces[carried]))
