"""Newton's method for one state of load: steps that keep every cell from folding, and a count of what they cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dvc.arrays import FloatArray, IntArray
from fe.assembly import Assembler
from fe.linear import SingularError, Solver
from fe.plate_rotation import Turning

_LEAST_SHARE = 1.0 / 256.0
_NEAR = 0.02  # forces out of balance, as a share of those on the supports, at which contact is looked at
LEAST_VOLUME = 0.002
"""No step brings det F at a quadrature point below this: from there the way to folding is short."""

_MOST_GROWTH = 3.0  # of the residual in one step
# Steps in a row that hardly lowered the residual, after which each is measured before it is made; and no more are.
_WANDERED, _LOST = 2, 12
BALANCED, SMALL_MM = 5, 0.1
"""So many steps in a row that end in balance, the last below this, count as found."""
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
    """A state in equilibrium, and what it took.

    Attributes
    ----------
    state : (unknowns,)
    forces : (unknowns,)
        Internal forces, N.
    iterations : int
    """

    state: FloatArray
    forces: FloatArray
    iterations: int


def equilibrium(
    assembler: Assembler,
    solver: Solver,
    state: FloatArray,
    outside: FloatArray,
    held: IntArray,
    moves: FloatArray,
    tolerance: Tolerance,
    changed: Callable[[FloatArray, FloatArray], bool] = lambda _state, _forces: False,
    told: Callable[[str], None] = lambda _: None,
    turning: Turning | None = None,
) -> Converged | None:
    """Find the state in which internal forces balance those from outside.

    Parameters
    ----------
    state : (unknowns,)
        First guess.
    outside : (equations,)
        Forces from outside, N.
    held : (h,) int
        Equations whose unknowns are prescribed.
    moves : (h,)
        How far those go from the first guess, mm.
    tolerance : Tolerance
    changed : callable
        ``changed(state, forces)`` is asked once a state is near equilibrium, and again there: whether what the unknowns
        follow has changed, as where more of a surface touches. It may move the state to where that is so.
    told : callable
        Gets a line for each step.
    turning : Turning, optional
        A plate that turns.

    Returns
    -------
    Converged or None
        None if it does not converge; where forces alone are given, `fe.descent` may.
    """
    now = state.copy()
    left = moves.copy()
    displacements = 3 * len(assembler.model.space.nodes_mm)
    forces, residual, lowest = assembler.residual(now)
    if not lowest > 0.0:
        return None
    wandering, balanced, balance, turn = 0, 0, 0.0, np.zeros(3)

    def unbalanced(at: FloatArray, carried: FloatArray, rest: FloatArray) -> float:
        of_forces = out_of_balance(outside - rest, assembler, held)
        return of_forces if turning is None else float(np.hypot(of_forces, turning.missing_n(at, carried)))

    for iteration in range(1, tolerance.iterations + 1):
        right = outside - residual
        right[assembler.idle] = 0.0
        before = unbalanced(now, forces, residual)
        data = assembler.held(assembler.tangent(now), right, held, left)
        try:
            solved = solver.solve(data, right, _ROUGH if balance > _NEAR else _INEXACT)
            if turning is not None:
                solved, turn = turning.solved(now, forces, data, solved, held, _INEXACT)
        except SingularError as failure:
            told(f"    {failure}")
            return None
        solved[held] = left  # exactly, though the solution may be rough
        change = assembler.spread(solved)
        if not np.isfinite(change).all():
            return None
        share = 1.0
        if wandering >= _WANDERED:
            share = _best_share(assembler, turning, now, change, turn, unbalanced)
        bound = np.inf if left.any() or iteration == 1 else _MOST_GROWTH * before
        while True:
            tried = _ahead(turning, now, change, turn, share)
            forces, residual, lowest = assembler.residual(tried)
            after = unbalanced(tried, forces, residual)
            if lowest > LEAST_VOLUME and after <= bound:
                break
            share *= 0.5
            if share < _LEAST_SHARE:
                return None
        largest = float(np.abs((tried - now)[:displacements]).max())
        now, left = tried, (1.0 - share) * left
        balance = after / max(reaction(assembler, forces), 1e-9)
        wandering = wandering + 1 if after > 0.5 * before and balance > tolerance.force else 0
        told(f"    {iteration}: out of balance {balance:.1e}, step {largest:.1e} mm, least det F {lowest:.3f}")
        if wandering >= _LOST:
            return None
        if left.any() or balance > _NEAR:
            continue
        if changed(now, forces):
            forces, residual, lowest = assembler.residual(now)
            balanced = 0
            continue
        balanced = balanced + 1 if balance <= tolerance.force else 0
        if balanced and share == 1.0 and largest <= tolerance.step_mm:
            return Converged(now, forces, iteration)
        if balanced >= BALANCED and largest <= SMALL_MM:
            told(f"    taken as found: {balanced} steps in a row ended in balance, the last of {largest:.1e} mm")
            return Converged(now, forces, iteration)
    return None


def _ahead(turning: Turning | None, now: FloatArray, change: FloatArray, turn: FloatArray, share: float) -> FloatArray:
    """The state after a share of a step."""
    return now + share * change if turning is None else turning.ahead(now, share * change, share * turn)


def _best_share(
    assembler: Assembler,
    turning: Turning | None,
    now: FloatArray,
    change: FloatArray,
    turn: FloatArray,
    unbalanced: Callable[[FloatArray, FloatArray, FloatArray], float],
) -> float:
    """The share of a step, of a few, that leaves the least out of balance."""
    left = {}
    for share in _SHARES:
        tried = _ahead(turning, now, change, turn, share)
        forces, residual, lowest = assembler.residual(tried)
        left[share] = unbalanced(tried, forces, residual) if lowest > LEAST_VOLUME else np.inf
    return min(_SHARES, key=lambda share: left[share])


def out_of_balance(unbalanced: FloatArray, assembler: Assembler, held: IntArray | None = None) -> float:
    """Norm of forces by equation (N), without those of unknowns that are prescribed."""
    balance = unbalanced.copy()
    balance[assembler.idle] = 0.0
    if held is not None:
        balance[held] = 0.0
    return float(np.linalg.norm(balance[assembler.force_equations]))


def reaction(assembler: Assembler, forces: FloatArray) -> float:
    """Norm of the force that fixed nodes and shared equations carry, N."""
    carried = (assembler.equation < 0) | (assembler.equation >= assembler.own_equations)
    return float(np.linalg.norm(forces[carried]))
