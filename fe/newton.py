"""Newton's method for one increment of load, in steps that keep every cell from folding."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dvc.arrays import FloatArray, IntArray
from fe.assembly import Assembler
from fe.linear import SingularError, Solver
from fe.plate import Parallel

_LEAST_SHARE = 1.0 / 256.0
_NEAR = 0.02  # forces out of balance, as a share of those on the supports, at which contact is looked at
LEAST_VOLUME = 0.002  # no step brings det F at a quadrature point below this: from there folding is near
_MOST_GROWTH = 3.0  # of the residual in one step
# Steps in a row that hardly lowered the residual: from the first number on several lengths are tried, at the second
# the search ends.
_WANDERED, _LOST = 2, 12
BALANCED, SMALL_MM = 5, 0.1  # so many steps in a row that end in balance, the last below this, count as converged
_SHARES = (1.0, 0.5, 0.25)
_ROUGH, _INEXACT = 0.05, 1e-3  # residual of a linear solution that is not exact, far from equilibrium and near it


@dataclass(frozen=True, slots=True)
class Tolerance:
    """When a state counts as in equilibrium.

    Attributes
    ----------
    force : float
        Largest norm of the forces out of balance, as a share of the forces on the plate and fixed nodes.
    step_mm : float
        Largest change of a displacement in the last step, mm. Five steps in a row that end within ``force``, the
        last below 0.1 mm, do as well: a cell that is nearly flat may have a way to move that costs no force.
    iterations : int
        Steps before giving up.
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
    """What an increment imposes from outside."""

    forces_n: FloatArray  # (equations,) external forces
    prescribed: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (h,) equations
    moves_mm: FloatArray = field(default_factory=lambda: np.empty(0))  # (h,) of their unknowns, from the first guess


def equilibrium(
    assembler: Assembler, solver: Solver, state: FloatArray, imposed: Imposed, tolerance: Tolerance,
    changed: Callable[[FloatArray, FloatArray], bool] = lambda _state, _forces: False,
    log: Callable[[str], None] = lambda _: None, rotation: Parallel | None = None,
) -> Converged | None:  # fmt: skip
    """Find the state in which internal forces balance the external ones, from a first guess (unknowns,).

    ``changed(state, forces)`` is called once a state is near equilibrium, and again there: whether what the unknowns
    follow has changed, as where more of a surface touches; it may move the state to where that is so. Without
    ``rotation`` the plate stays parallel. None if it does not converge; where only forces are given, `fe.descent` may.
    """
    newton = _Newton(assembler, solver, imposed, rotation or Parallel())
    displacements = 3 * len(assembler.model.space.nodes_mm)
    now, left = newton.at(state.copy()), imposed.moves_mm.copy()
    if not now.lowest > 0.0:
        return None
    wandering, balanced, balance = 0, 0, 0.0
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
        log(f"    {iteration}: out of balance {balance:.1e}, step {largest:.1e} mm, least det F {now.lowest:.3f}")
        if wandering >= _LOST:
            return None
        if left.any() or balance > _NEAR:
            continue
        if changed(now.state, now.forces):
            now, balanced = newton.at(now.state), 0
            continue
        balanced = balanced + 1 if balance <= tolerance.force else 0
        if balanced and share == 1.0 and largest <= tolerance.step_mm:
            return Converged(now.state, now.forces, iteration)
        if balanced >= BALANCED and largest <= SMALL_MM:
            log(f"    accepted: {balanced} steps in a row ended in balance, the last of {largest:.1e} mm")
            return Converged(now.state, now.forces, iteration)
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Iterate:
    """A state on the way to equilibrium: its forces by unknown and by equation, least det F, and imbalance."""

    state: FloatArray
    forces: FloatArray
    residual: FloatArray
    lowest: float
    unbalanced_n: float


@dataclass(frozen=True, slots=True, eq=False)
class _Newton:
    """Steps of Newton's method for one increment: the change of all unknowns, and the plate's turn (3,)."""

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
        """The step from an iterate, with ``left_mm`` (h,) of the prescribed moves still to be made."""
        held = self.imposed.prescribed
        right = self.imposed.forces_n - now.residual
        right[self.assembler.idle] = 0.0
        data = self.assembler.held(self.assembler.tangent(now.state), right, held, left_mm)
        level = self.solver.solve(data, right, accuracy)
        solved, turn = self.rotation.solved(now.state, now.forces, data, level, held)
        solved[held] = left_mm  # exactly, though the solution may be rough
        change = self.assembler.spread(solved)
        if not np.isfinite(change).all():
            raise SingularError("The linear solution is not finite.")
        return change, turn

    def ahead(self, now: _Iterate, step: tuple[FloatArray, FloatArray], share: float) -> _Iterate:
        """The iterate after a share of a step."""
        change, turn = step
        return self.at(self.rotation.ahead(now.state, share * change, share * turn))

    def searched(
        self, now: _Iterate, step: tuple[FloatArray, FloatArray], bound_n: float, *, several: bool
    ) -> tuple[_Iterate, float]:
        """The iterate after a step, halved until no cell folds and the bound holds, and its share; 0 if none does.

        The first share is the whole step or, of ``several``, the one that leaves the least imbalance.
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
    """Norm of forces by equation (N), without those of unknowns that are prescribed."""
    balance = unbalanced.copy()
    balance[assembler.idle] = 0.0
    if prescribed is not None:
        balance[prescribed] = 0.0
    return float(np.linalg.norm(balance[assembler.force_equations]))


def reaction(assembler: Assembler, forces: FloatArray) -> float:
    """Norm of the force that fixed nodes and shared equations carry, N."""
    carried = (assembler.equation < 0) | (assembler.equation >= assembler.own_equations)
    return float(np.linalg.norm(forces[carried]))
