"""Viscous descent to equilibrium, where Newton's method fails: a stiff skin that buckles over soft fat.

At such a load the next equilibrium is far, and on the way the tangent has directions along which Newton's step goes
against the forces. A body without inertia in a viscous medium follows them: c V du/dt = forces out of balance, V the
nodes' volumes. Its implicit steps, (K + d V) du = forces with d = c / dt, become Newton's as d -> 0 (pseudo-transient
continuation; Kelley and Keyes 1998, doi:10.1137/S0036142996304796). d rises where a step would go against the forces or
the tangent predicts the remaining forces badly, and falls where it predicts them well. A few nodes, those of nearly
flat cells, are predicted badly for long: the medium is thicker there, so that they do not slow down the rest.
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
_LARGEST_MM, _TOO_FAR_MM = 1.0, 3.0  # a longer step is shortened to that; a step that long is damped more
_MOST_GROWTH = 3.0, 1.5  # of the forces out of balance in one step: far from balance, and near it
_NEAR = 10.0  # times what is asked
# Change of d after a step, by the share of those forces that the tangent did not predict: no node counts more than
# _CLIPPED, those on the plate not at all.
_CHANGES = ((0.1, 0.2), (0.5, 1.0 / 3.0), (1.0, 0.5), (np.inf, 1.0))
_CLIPPED = 0.1
_RISE = 4.0  # of d for a step that goes uphill, too far, or folds a cell
# After a step that leaves far larger forces: of d, and of the medium's thickness at the nodes that caused most of it.
_RISE_OVER, _THICKENED, _MOST_OF_IT = 1.5, 4.0, 0.1
# Change of the medium's thickness at a node after a step, by the share of the forces that was not predicted there.
_THICKNESSES = ((0.1, 0.5), (0.3, 1.0), (np.inf, 4.0))
_THICKEST = 1e3
_BORNE = 0.5  # share of the forces that the medium may still take in the last step
_ACCURACY = 1e-3  # of linear solutions


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """A step that was tried: where it leads, with which forces, and how wrong its tangent was."""

    state: FloatArray
    forces: FloatArray
    residual: FloatArray
    lowest: float
    largest_mm: float
    unforeseen_n: FloatArray  # (n,) forces at nodes that the tangent did not predict; 0 for nodes on the plate
    borne_n: float  # forces that the medium takes
    after_n: float  # forces out of balance after the step


def descend(
    assembler: Assembler, solver: Solver, state: FloatArray, outside: FloatArray, tolerance: Tolerance,
    changed: Callable[[FloatArray, FloatArray], bool], log: Callable[[str], None], is_over: Callable[[], bool],
) -> Converged | None:  # fmt: skip
    """Find the equilibrium to which a body in a viscous medium moves under forces from ``outside`` (equations,), N.

    The rest as in `fe.newton.equilibrium`, but no unknown is prescribed; ``changed`` is called after every step, and
    ``is_over`` before it, to stop. None if equilibrium is not reached in 400 steps, or a node moves farther than the
    body is large. As in `fe.newton.Tolerance`, several steps that stay in balance are enough.
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
            f"    downhill {count}: out of balance {balance:.1e}, step {step.largest_mm:.1e} mm, least det F "
            f"{step.lowest:.3f}, damping {damping:.1e}"
        )
        moved_mm = float(np.abs(now[: -model.space.pressures]).max())
        if moved_mm > largest_mm:
            log(f"    given up: a node has moved by {moved_mm:.0f} mm, and the body is not that large")
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
    """The factor of each value: the one beside the first limit that it does not exceed."""
    limits, factors = np.array(table).T
    return np.asarray(factors[np.searchsorted(limits, values)])


def _tried(
    assembler: Assembler, solver: Solver, now: FloatArray, tangent: FloatArray, outside: FloatArray,
    residual: FloatArray, medium: FloatArray,
) -> _Step | None:  # fmt: skip
    """A damped step from a state; None where it goes against the forces or folds a cell. ``medium`` is d V, N/mm."""
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
    unforeseen = outside - left - (1.0 - share) * right - borne
    unforeseen[assembler.own_equations :] = 0.0
    at_nodes = assembler.spread(unforeseen)[: -assembler.model.space.pressures].reshape(-1, 3)
    return _Step(
        now + share * moves, forces, left, lowest, share * longest_mm, np.linalg.norm(at_nodes, axis=1),
        out_of_balance(borne, assembler), out_of_balance(outside - left, assembler),
    )  # fmt: skip
