"""Viscous descent to equilibrium for loads at which Newton's method fails, such as stiff skin that buckles over fat.

At such a load the next equilibrium is far away, and the tangent is indefinite on the way: Newton's step may point
against the forces. A body without inertia in a viscous medium follows the forces: c V du/dt = residual forces, V the
volumes of the nodes. Its implicit steps, (K + d V) du = forces with d = c / dt, become Newton steps as d -> 0
(pseudo-transient continuation; Kelley and Keyes 1998, doi:10.1137/S0036142996304796). d increases if a step would go
against the forces or if the tangent predicts the remaining forces badly; it decreases if the prediction is good. At a
few nodes, those of nearly flat cells, the prediction stays bad. The damping is higher there, so that these nodes do not
slow down the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dvc.arrays import FloatArray
from fe.assembly import Assembler
from fe.linear import SingularError, Solver
from fe.newton import BALANCED, LEAST_VOLUME, SMALL_MM, Converged, Tolerance, out_of_balance, reaction

_FIRST, _LEAST, _MOST = 1e-5, 1e-9, 1e6  # damping d, N/mm4
_MOST_STEPS = 400
_LARGEST_MM, _TOO_FAR_MM = 1.0, 3.0  # longer steps are shortened to the first; beyond the second, damping increases
_MOST_GROWTH = 3.0, 1.5  # of the residual in one step: far from equilibrium, and near it
_NEAR = 10.0  # times the tolerance
# Factor on d after a step, by the fraction of the residual that the tangent did not predict. A node counts at most
# _CLIPPED, nodes on the plate do not count.
_CHANGES = ((0.1, 0.2), (0.5, 1.0 / 3.0), (1.0, 0.5), (np.inf, 1.0))
_CLIPPED = 0.1
_RISE = 4.0  # factor on d for a step that goes against the forces, too far, or folds a cell
# Factors after a step that increases the residual strongly: on d, and on the damping of the nodes that caused most.
_RISE_OVER, _THICKENED, _MOST_OF_IT = 1.5, 4.0, 0.1
# Factor on the damping of a node after a step, by the fraction of the forces that was not predicted there.
_THICKNESSES = ((0.1, 0.5), (0.3, 1.0), (np.inf, 4.0))
_THICKEST = 1e3
_BORNE = 0.5  # largest fraction of the forces that the medium may carry in the last step
_ACCURACY = 1e-3  # of linear solutions


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A trial step: the new state, its forces, and the error of the tangent's prediction."""

    state: FloatArray
    forces: FloatArray
    residual: FloatArray
    lowest: float
    largest_mm: float
    unforeseen_n: FloatArray  # (n,) forces at nodes that the tangent did not predict; 0 for nodes on the plate
    borne_n: float  # forces that the medium carries
    after_n: float  # residual forces after the step


def descend(
    assembler: Assembler, solver: Solver, state: FloatArray, outside: FloatArray, tolerance: Tolerance,
    changed: Callable[[FloatArray, FloatArray], bool], log: Callable[[str], None], is_over: Callable[[], bool],
) -> Converged | None:  # fmt: skip
    """Find the equilibrium that a body in a viscous medium reaches under forces from ``outside`` (equations,), N.

    As `fe.newton.equilibrium`, but without prescribed unknowns. ``changed`` is called after every step; ``is_over`` is
    called before every step and stops the search. None if equilibrium is not reached in 400 steps, or if a node moves
    farther than the size of the body. As in `fe.newton.Tolerance`, several consecutive steps within the force tolerance
    are enough.
    """
    model = assembler.model
    now, damping, thickness = state.copy(), _FIRST, np.ones(len(model.space.nodes_mm))
    cells, growth, balanced = model.space.cells, _MOST_GROWTH[0], 0
    each = np.repeat(model.volumes_mm3 / cells.shape[1], cells.shape[1])
    volumes_mm3 = np.bincount(cells.ravel(), weights=each, minlength=len(thickness))
    largest_mm = float(np.ptp(model.space.nodes_mm, axis=0).max())
    forces, residual, lowest = assembler.residual(now)
    if not lowest > 0.0:
        return None
    tangent = assembler.tangent(now)
    for count in range(1, _MOST_STEPS + 1):
        if is_over():
            return None
        before_n = max(out_of_balance(outside - residual, assembler), 1e-300)
        by_node = np.repeat(damping * thickness * volumes_mm3, 3)
        medium = assembler.by_equation(np.concatenate([by_node, np.zeros(model.space.pressures)]))
        step = _tried(assembler, solver, now, tangent, outside, residual, medium)
        if step is None or step.after_n > growth * before_n:
            damping *= _RISE if step is None else _RISE_OVER
            if step is not None:
                blamed = step.unforeseen_n > _MOST_OF_IT * step.unforeseen_n.max()
                thickness = np.minimum(np.where(blamed, _THICKENED, 1.0) * thickness, _THICKEST)
            if damping > _MOST:
                return None
            continue
        now, forces, residual = step.state, step.forces, step.residual
        balance = step.after_n / max(reaction(assembler, forces), 1e-9)
        log(
            f"    viscous descent {count}: residual {balance:.1e}, step {step.largest_mm:.1e} mm, smallest det F "
            f"{step.lowest:.3f}, damping {damping:.1e}"
        )
        moved_mm = float(np.abs(now[: -model.space.pressures]).max())
        if moved_mm > largest_mm:
            log(f"    stopped: a node has moved by {moved_mm:.0f} mm, more than the size of the body")
            return None
        wrong = step.unforeseen_n / before_n
        damping = max(_LEAST, damping * float(_by(_CHANGES, np.linalg.norm(np.minimum(wrong, _CLIPPED)))))
        thickness = np.clip(thickness * _by(_THICKNESSES, wrong), 1.0, _THICKEST)
        growth = _MOST_GROWTH[balance <= _NEAR * tolerance.force]
        balanced = balanced + 1 if balance <= tolerance.force else 0
        small_mm = SMALL_MM if balanced >= BALANCED else tolerance.step_mm
        if changed(now, forces):
            forces, residual, _ = assembler.residual(now)
            balanced = 0
        elif balanced and step.largest_mm <= small_mm and step.borne_n <= _BORNE * before_n:
            return Converged(now, forces, count)
        tangent = assembler.tangent(now)
    return None


def _by(table: Sequence[tuple[float, float]], values: npt.ArrayLike) -> FloatArray:
    """The factor for each value: that of the first limit that the value does not exceed."""
    limits, factors = np.array(table).T
    return np.asarray(factors[np.searchsorted(limits, values)])


def _tried(
    assembler: Assembler, solver: Solver, now: FloatArray, tangent: FloatArray, outside: FloatArray,
    residual: FloatArray, medium: FloatArray,
) -> _Step | None:  # fmt: skip
    """A damped step from a state; None if it goes against the forces or folds a cell. ``medium`` is d V, N/mm."""
    right = outside - residual
    right[assembler.idle] = 0.0
    data = tangent.copy()
    data[assembler.indptr[:-1]] += medium  # the diagonal is the first entry of each row
    try:
        change = solver.solve(data, right, _ACCURACY)
    except SingularError:
        return None
    moves = assembler.spread(change)
    longest_mm = float(np.abs(moves[: -assembler.model.space.pressures]).max())
    # Twice the energy of the step, with damping added to the stiffness; negative if the step goes against the forces.
    energy = float((change * right) @ np.where(assembler.force_equations, 1.0, -1.0))
    if not (energy > 0.0 and longest_mm <= _TOO_FAR_MM):
        return None
    share = _LARGEST_MM / max(longest_mm, _LARGEST_MM)
    forces, left, lowest = assembler.residual(now + share * moves)
    if not lowest > LEAST_VOLUME:
        return None
    borne = share * medium * change
    unforeseen = outside - left - (1.0 - share) * right - borne
    unforeseen[assembler.own_equations :] = 0.0
    at_nodes = assembler.spread(unforeseen)[: -assembler.model.space.pressures].reshape(-1, 3)
    return _Step(
        now + share * moves, forces, left, lowest, share * longest_mm, np.linalg.norm(at_nodes, axis=1),
        out_of_balance(borne, assembler), out_of_balance(outside - left, assembler),
    )  # fmt: skip
