"""The way of a plate against tissue: from one equilibrium to the next, in steps as large as converge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.mesh import TetMesh
from fe.assembly import Assembler
from fe.elements import edges_of
from fe.linear import Solver
from fe.model import Model
from fe.newton import Tolerance, equilibrium
from fe.plate import Contact, Hold, Plate

SURFACE = "skin"
"""Name of the facets that the plate may touch."""

_FIRST_STEP = 0.25
_LEAST_STEP, _SOFT_STEP = 1.0 / 512.0, 1.0 / 32.0
_GROWTH, _SHRINK = 1.7, 0.4
_APPROACH_MM, _MOST_APPROACH_MM = 0.25, 0.6
_LEAST_APPROACH_MM = 0.01
_ENOUGH = 0.2  # share of the normal load up to which the plate is moved, and not yet pushed


@dataclass(frozen=True, slots=True, eq=False)
class Goal:
    """What the plate is to reach along each of its three axes: a force, or a travel.

    Attributes
    ----------
    values : (3,)
        Forces in N, travels in mm.
    travels : (3,) bool
        Along which axes a travel is given.
    """

    values: FloatArray
    travels: BoolArray

    def unsheared(self) -> Goal:
        """The same along the normal, without a force across it."""
        return Goal(self.values * [1.0, 0.0, 0.0], self.travels & [True, False, False])


class Path:
    """The state on its way, and what moves it; vectors along the plate's axes.

    Attributes
    ----------
    state : (unknowns,)
    travel, force : (3,)
        The plate's, mm and N.
    curve : list of (6,)
        Travel and force of every equilibrium so far.
    iterations : int
        Newton steps so far.
    """

    def __init__(
        self,
        model: Model,
        mesh: TetMesh,
        plate: Plate,
        fixed: Sequence[str],
        threads: int,
        tolerance: Tolerance,
        tell: Callable[[str], None],
    ) -> None:
        self.model, self.tolerance, self.tell = model, tolerance, tell
        held = np.unique(np.concatenate([_nodes_on(model, mesh, name) for name in fixed]))
        touching = np.setdiff1d(_nodes_on(model, mesh, SURFACE), held)
        self.contact = Contact(plate, model.space.nodes_mm, touching)
        self.assembler = Assembler(model, (3 * held[:, None] + np.arange(3)).ravel(), self.contact.may_follow)
        self.solver = Solver(self.assembler.indptr, self.assembler.indices, threads=threads)
        self.extent_mm = float(np.ptp(model.space.nodes_mm, axis=0).max())
        self.state = np.zeros(model.unknowns)
        self.travel, self.force = np.array([plate.gap_mm, 0.0, 0.0]), np.zeros(3)
        self.curve: list[FloatArray] = [np.concatenate([self.travel, self.force])]
        self.iterations = 0

    def standing(self, goal: Goal) -> FloatArray:
        """What is reached (3,) of what a goal asks for."""
        return np.where(goal.travels, self.travel, self.force)

    def approach(self, goal: Goal) -> bool:
        """Touch, and move on to a part of the normal load asked for; whether raising it further makes sense."""
        self.contact.touch_first(self.state)
        if goal.travels[0]:
            part = self.travel + _ENOUGH * (goal.values - self.travel)
            return self.raise_to(Goal(part, goal.travels).unsheared())
        self._push(0, _ENOUGH * goal.values[0], goal.values[0])
        return True

    def raise_to(self, goal: Goal, progress: Callable[[float], None] = lambda _: None) -> bool:
        """Go on from what is to the goal, in steps as large as converge; whether it is there.

        Where tissue gives way too much under a force, the plate is moved along it for a while, and then pushed again.
        It is given up where the plate has moved as far as the body is large. A travel goes on in steps so small that
        what touches does so in its order.
        """
        before = self.standing(goal)
        way = goal.values - before
        axis = int(np.argmax(np.abs(way)))
        largest = _MOST_APPROACH_MM / max(float(np.abs(way[goal.travels]).max(initial=0.0)), 1e-12)
        done, step, pushed = 0.0, _FIRST_STEP, bool(goal.travels.any())
        while done < 1.0 and step > min(_LEAST_STEP, 0.01 * largest):
            step = min(step, largest)
            share = min(1.0, done + step)
            kept = self._kept()
            if self._go(goal.travels, before + share * way):
                done, step = share, step * _GROWTH
                pushed = bool(goal.travels.any())
                self._told(f"{done:.0%} of the way")
                progress(done)
                continue
            self._restore(kept)
            step *= _SHRINK
            if step < _SOFT_STEP and not pushed:
                pushed = True
                self._push(axis, before[axis] + min(1.0, done + _FIRST_STEP) * way[axis], goal.values[axis])
                done, step = float((self.force - before) @ way / (way @ way)), _FIRST_STEP
        return done >= 1.0

    def _push(self, axis: int, enough_n: float, most_n: float) -> None:
        """Move the plate along an axis until its force there is enough, or no more can be had; never past the most."""
        sign = 1.0 if most_n >= self.force[axis] else -1.0
        farthest = self.travel[axis] + sign * float(np.ptp(self.model.space.nodes_mm[:, 0]))
        step = _APPROACH_MM
        moving = np.arange(3) == axis
        while sign * (enough_n - self.force[axis]) > 0.0 and step > _LEAST_APPROACH_MM:
            if sign * (farthest - self.travel[axis]) < step:
                break
            kept = self._kept()
            aim = np.where(moving, self.travel + sign * step, self.force)
            if self._go(moving, aim) and sign * (most_n - self.force[axis]) > 0.0:
                step = min(_GROWTH * step, _MOST_APPROACH_MM)
                self._told("moved")
            else:
                self._restore(kept)
                step *= _SHRINK

    def _go(self, travels: BoolArray, aim: FloatArray) -> bool:
        """Find equilibrium at travels (mm) along some of the plate's axes, and under forces (N) along the others."""
        self.contact.begin(self.state)
        plate = self.assembler.own_equations + np.arange(3)
        outside = np.zeros(self.assembler.size)
        outside[plate] = np.where(travels, 0.0, aim)
        self.assembler.share(self.contact.followers)
        found = equilibrium(
            self.assembler,
            self.solver,
            self.state,
            outside,
            plate[travels],
            (aim - self.travel)[travels],
            self.tolerance,
            self._changed,
            self.tell,
        )
        if found is None:
            return False
        self.travel = self.contact.travel_mm(found.state)
        if np.abs(self.travel - [self.contact.plate.gap_mm, 0.0, 0.0]).max() > self.extent_mm:
            self.tell("the plate would have moved farther than the body is large")
            return False
        self.force = self.contact.force_n(found.forces)
        self.state = found.state
        self.iterations += found.iterations
        self.curve.append(np.concatenate([self.travel, self.force]))
        return True

    def _changed(self, state: FloatArray, forces: FloatArray) -> bool:
        if not self.contact.update(state, forces):
            return False
        self.assembler.share(self.contact.followers)
        return True

    def _kept(self) -> _Kept:
        return self.state, self.travel, self.force, self.contact.hold, len(self.curve)

    def _restore(self, kept: _Kept) -> None:
        self.state, self.travel, self.force, self.contact.hold, known = kept
        del self.curve[known:]

    def _told(self, what: str) -> None:
        travel, force = (", ".join(f"{v:.3f}" for v in vector) for vector in (self.travel, self.force))
        self.tell(f"{what}: travel {travel} mm, force {force} N, {len(self.contact.held)} nodes on the plate")


_Kept = tuple[FloatArray, FloatArray, FloatArray, Hold, int]


def _nodes_on(model: Model, mesh: TetMesh, facets: str) -> IntArray:
    """Displacement nodes on named facets; those in the middle of edges too."""
    corners = np.unique(mesh.facets[facets])
    if model.element.name != "P2":
        return corners
    return np.union1d(corners, model.space.middles(edges_of(mesh.facets[facets])))
