"""Downhill to equilibrium, where Newton's method loses its way: a stiff skin that buckles over soft fat.

At such a load the next equilibrium is far, and in between the tangent has directions along which a step of Newton's
goes against the forces. A body without inertia in a viscous medium goes with them: c V du/dt = forces out of balance,
V the nodes' volumes. Implicit steps of it, (K + d V) du = forces with d = c / dt, are Newton's as d -> 0
(pseudo-transient continuation; Kelley and Keyes 1998, doi:10.1137/S0036142996304796). d rises where a step would go
against the forces, or the tangent foretells badly what is left of them, and falls where it foretells well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dvc.arrays import FloatArray
from fe.assembly import Assembler
from fe.linear import SingularError, Solver
from fe.newton import BALANCED, LEAST_VOLUME, SMALL_MM, Converged, Tolerance, out_of_balance, reaction

_FIRST, _LEAST, _MOST = 1e-5, 1e-9, 1e6  # damping d, N/mm4
_RISE = 4.0  # of d for a step that will not do
_MOST_STEPS = 400
_LARGEST_MM, _TOO_FAR_MM = 1.0, 3.0  # a longer step is shortened to that; a step that long is damped more
_MOST_GROWTH = 3.0, 1.5  # of the forces out of balance in one step: far from balance, and near it
_NEAR = 10.0  # times what is asked
# Of d after a step, by the share of those forces that was not foretold; of cells that are nearly flat it never is well.
_CHANGES = ((0.1, 0.2), (0.5, 1.0 / 3.0), (1.0, 0.5), (3.0, 1.0), (np.inf, 2.0))
_BORNE = 0.5  # share of the forces that the medium may still take in the last step
_ACCURACY = 1e-3  # of linear solutions


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A step that was tried: where it leads, with which forces, and by how much its tangent was wrong.

    Attributes
    ----------
    wrong, borne : float
        Forces not foretold, and those that the medium takes, as shares of the forces out of balance before.
    after_n : float
        Out of balance there, N.
    """

    state: FloatArray
    forces: FloatArray
    residual: FloatArray
    lowest: float
    largest_mm: float
    wrong: float
    borne: float
    after_n: float


def descend(
    assembler: Assembler,
    solver: Solver,
    state: FloatArray,
    outside: FloatArray,
    tolerance: Tolerance,
    changed: Callable[[FloatArray, FloatArray], bool] = lambda _state, _forces: False,
    told: Callable[[str], None] = lambda _: None,
    farthest_mm: float = np.inf,
) -> Converged | None:
    """Find the state in balance with forces from outside to which a body in a viscous medium comes.

    Parameters
    ----------
    assembler, solver, state, outside, tolerance, told
        As in `fe.newton.equilibrium`; no unknown is prescribed.
    changed : callable
        As there; asked after every step.
    farthest_mm : float
        Given up where a node has moved by more, mm.

    Returns
    -------
    Converged or None
        None if it is not found in 400 steps. As in `fe.newton.Tolerance`, steps that stay in balance are enough.
    """
    model = assembler.model
    volumes = np.concatenate([np.repeat(model.node_volumes_mm3, 3), np.zeros(model.space.pressures)])
    now, damping, growth, balanced = state.copy(), _FIRST, _MOST_GROWTH[0], 0
    forces, residual, lowest = assembler.residual(now)
    if not lowest > 0.0:
        return None
    tangent = assembler.tangent(now)
    for count in range(1, _MOST_STEPS + 1):
        before_n = out_of_balance(outside - residual, assembler)
        medium = damping * assembler.by_equation(volumes)
        step = _tried(assembler, solver, now, tangent, outside, residual, medium, before_n)
        if step is None or step.after_n > growth * before_n:
            damping *= _RISE
            if damping > _MOST:
                return None
            continue
        now, forces, residual = step.state, step.forces, step.residual
        balance = step.after_n / max(reaction(assembler, forces), 1e-9)
        told(
            f"    downhill {count}: out of balance {balance:.1e}, step {step.largest_mm:.1e} mm, least det F "
            f"{step.lowest:.3f}, damping {damping:.1e}"
        )
        moved_mm = float(np.abs(now[: -model.space.pressures]).max())
        if moved_mm > farthest_mm:
            told(f"    given up: a node has moved by {moved_mm:.0f} mm, and the body is not that large")
            return None
        damping = max(_LEAST, damping * next(factor for limit, factor in _CHANGES if step.wrong <= limit))
        growth = _MOST_GROWTH[balance <= _NEAR * tolerance.force]
        balanced = balanced + 1 if balance <= tolerance.force else 0
        small_mm = SMALL_MM if balanced >= BALANCED else tolerance.step_mm
        if changed(now, forces):
            forces, residual, _ = assembler.residual(now)
            balanced = 0
        elif balanced and step.largest_mm <= small_mm and step.borne <= _BORNE:
            return Converged(now, forces, count)
        tangent = assembler.tangent(now)
    return None


def _tried(
    assembler: Assembler,
    solver: Solver,
    now: FloatArray,
    tangent: FloatArray,
    outside: FloatArray,
    residual: FloatArray,
    medium: FloatArray,
    before_n: float,
) -> _Step | None:
    """A damped step from a state with that tangent and residual; None where it goes against the forces, or folds.

    ``medium`` (equations,) is d V, N/mm; ``before_n`` how much is out of balance, N.
    """
    right = outside - residual
    right[assembler.idle] = 0.0
    data = tangent.copy()
    data[assembler.indptr[:-1]] += medium  # the diagonal stands first in its row
    try:
        change = solver.solve(data, right, _ACCURACY)
    except SingularError:
        return None
    moves = assembler.spread(change)
    longest_mm = float(np.abs(moves[: -assembler.model.space.pressures]).max())
    # Twice the energy of the step in a body that is stiffer by the medium; that of a step uphill is below zero.
    energy = float((change * right) @ np.where(assembler.force_equations, 1.0, -1.0))
    if not (energy > 0.0 and longest_mm <= _TOO_FAR_MM):
        return None
    share = _LARGEST_MM / max(longest_mm, _LARGEST_MM)
    forces, left, lowest = assembler.residual(now + share * moves)
    if not lowest > LEAST_VOLUME:
        return None
    borne = share * medium * change
    before_n = max(before_n, 1e-300)
    return _Step(
        now + share * moves,
        forces,
        left,
        lowest,
        share * longest_mm,
        out_of_balance(outside - left - (1.0 - share) * right - borne, assembler) / before_n,
        out_of_balance(borne, assembler) / before_n,
        out_of_balance(outside - left, assembler),
    )
