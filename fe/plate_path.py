"""The way of a plate against tissue: from one equilibrium to the next, in steps as large as converge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.mesh import TetMesh
from fe.assembly import Assembler
from fe.descent import descend
from fe.elements import edges_of
from fe.linear import Solver
from fe.model import Model
from fe.newton import Converged, Tolerance, equilibrium
from fe.plate import Contact, Hold, Plate
from fe.plate_rotation import Turning
from fe.surface_sets import SKIN

_FIRST_STEP = 0.25
_LEAST_STEP, _SOFT_STEP = 1.0 / 512.0, 1.0 / 32.0
_TIPPING = 0.5  # of how far a plate was in when it was level: it sinks in when it is let go
_DOWNHILL_STEP, _LEAST_DOWNHILL_STEP = 0.1, 1.0 / 128.0
_GROWTH, _SHRINK = 1.7, 0.4
_APPROACH_MM, _MOST_APPROACH_MM = 0.25, 0.6
_LEAST_APPROACH_MM = 0.01
_ALONG_NORMAL = np.array([True, False, False])
_ENOUGH = (0.2, 0.4, 0.6, 0.8)  # shares of the normal load up to which the plate is moved, and not yet pushed


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

    @property
    def sheared(self) -> bool:
        """Whether it asks for a force or a travel across the normal."""
        return bool(self.values[1:].any() or self.travels[1:].any())

    def unsheared(self) -> Goal:
        """The same along the normal, without a force across it."""
        return Goal(self.values * [1.0, 0.0, 0.0], self.travels & [True, False, False])


@dataclass(frozen=True, slots=True, eq=False)
class PlateState:
    """A plate in equilibrium; vectors along its axes at the start.

    Attributes
    ----------
    travel_mm : (3,)
        Of its pivot, from its start.
    force_n : (3,)
        On the tissue.
    turn_deg : (3,)
        Axis of its rotation times the angle.
    moment_nmm : (3,)
        On the tissue, about its pivot.
    area_mm2 : float
        Of the surface that holds to it, as it is now: of faces with all their corners on the plate.
    """

    travel_mm: FloatArray
    force_n: FloatArray
    turn_deg: FloatArray
    moment_nmm: FloatArray
    area_mm2: float

    @property
    def pressure_mpa(self) -> float:
        """Mean contact pressure: normal force over area; NaN where no whole face holds."""
        return float(self.force_n[0]) / self.area_mm2 if self.area_mm2 > 0.0 else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """An equilibrium with all that it takes to go on from it.

    Attributes
    ----------
    unknowns : (unknowns,)
        Displacements, along the plate's axes, and pressures.
    plate : PlateState
    hold : Hold
    """

    unknowns: FloatArray
    plate: PlateState
    hold: Hold


class Path:
    """The state on its way, and what moves it; vectors along the plate's axes.

    Attributes
    ----------
    state : (unknowns,)
    plate : PlateState
    curve : list of PlateState
        Every equilibrium so far.
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
        over: Callable[[], bool] = lambda: False,
    ) -> None:
        self.model, self.tolerance, self.tell = model, tolerance, tell
        self.over = over  # whether to stop where it stands
        self.settled: Callable[[], None] = lambda: None  # called at each equilibrium from which one can go on
        held = np.unique(np.concatenate([_nodes_on(model, mesh, name) for name in fixed]))
        touching = np.setdiff1d(_nodes_on(model, mesh, SKIN), held)
        self.contact = Contact(plate, model.space.nodes_mm, touching)
        self.assembler = Assembler(model, (3 * held[:, None] + np.arange(3)).ravel(), self.contact.may_follow)
        self.solver = Solver(self.assembler.indptr, self.assembler.indices, threads=threads)
        self.extent_mm = float(np.ptp(model.space.nodes_mm, axis=0).max())
        self.state = np.zeros(model.unknowns)
        self._faces = mesh.facets[SKIN]
        self.plate = PlateState(np.array([plate.gap_mm, 0.0, 0.0]), np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
        self.curve = [self.plate]
        self.iterations = 0

    def reached(self, goal: Goal) -> FloatArray:
        """What is reached (3,) of what a goal asks for."""
        return np.where(goal.travels, self.plate.travel_mm, self.plate.force_n)

    def approach(self, goal: Goal) -> bool:
        """Touch, move on to a part of the normal load asked for, and let a plate go that turns.

        Until then it stays level, as a plate on a node or two would tip over; and if it cannot be let go there, it is
        pressed further and tried again. Returns whether going on makes sense.
        """
        if not len(self.contact.held):
            self.contact.touch_first(self.state)
        start = np.array([self.contact.plate.gap_mm, 0.0, 0.0])
        for share in _ENOUGH:
            if goal.travels[0]:
                part = start + share * (goal.values - start)
                if part[0] > self.plate.travel_mm[0] and not self.raise_to(Goal(part, goal.travels).unsheared()):
                    return False
            else:
                self._push(share * goal.values[0], goal.values[0])
            if self.over():
                return False
            if not self.contact.plate.turns or self._let_go():
                return True
        return False

    def _let_go(self) -> bool:
        """Take the moment away that kept the plate level, under the force that it has.

        A plate that is held less sinks in further; one that comes back out instead tips over on too few nodes.
        """
        level, force, moment = self.standing, self.plate.force_n, self.plate.moment_nmm
        self.contact.hold = replace(self.contact.hold, loose=True)
        gap_mm, level_mm = self.contact.plate.gap_mm, level.plate.travel_mm[0]
        least_mm = gap_mm + _TIPPING * (level_mm - gap_mm)
        left, step = 1.0, 0.5
        while left > 0.0 and step > _LEAST_STEP and not self.over():
            kept = self.standing
            least = max(0.0, left - step)
            if self._go(np.zeros(3, dtype=bool), force, least * moment):
                if self.plate.travel_mm[0] < least_mm:
                    break
                left, step = least, step * _GROWTH
                self._told(f"{1.0 - left:.0%} let go")
            else:
                self._back(kept)
                step *= _SHRINK
        if left > 0.0:
            self._back(level)
        return left == 0.0

    def raise_to(self, goal: Goal) -> bool:
        """Go on from what is to the goal, in steps as large as converge; whether it is there.

        Where Newton's method does not get on under forces, it goes on downhill (`fe.descent`), with a plate on
        tape that does not turn. A travel goes on in steps so small that what touches does so in its order.
        """
        before = self.reached(goal)
        way = goal.values - before
        largest = _MOST_APPROACH_MM / max(float(np.abs(way[goal.travels]).max(initial=0.0)), 1e-12)
        done, step, downhill = 0.0, _FIRST_STEP, False
        least = min(_LEAST_STEP, 0.01 * largest)
        while done < 1.0 and step > (_LEAST_DOWNHILL_STEP if downhill else least) and not self.over():
            step = min(step, largest)
            share = min(1.0, done + step)
            kept = self.standing
            if self._go(goal.travels, before + share * way, downhill=downhill):
                done, step = share, step if downhill else step * _GROWTH
                self._told(f"{done:.0%} of the way")
                self.settled()
                continue
            self._back(kept)
            step *= _SHRINK
            if step < _SOFT_STEP and not (downhill or goal.travels.any()) and self.contact.stays:
                downhill, step = True, _DOWNHILL_STEP
        return done >= 1.0

    def _push(self, enough_n: float, most_n: float) -> None:
        """Move the plate along its normal until its force is enough, or no more can be had; never past the most."""
        farthest = self.plate.travel_mm[0] + float(np.ptp(self.model.space.nodes_mm[:, 0]))
        step, growth = _APPROACH_MM, _GROWTH
        while self.plate.force_n[0] < enough_n and step > _LEAST_APPROACH_MM and not self.over():
            if farthest - self.plate.travel_mm[0] < step:
                break
            kept = self.standing
            aim = np.array([self.plate.travel_mm[0] + step, *self.plate.force_n[1:]])
            if self._go(_ALONG_NORMAL, aim) and self.plate.force_n[0] < most_n:
                step = min(growth * step, _MOST_APPROACH_MM)
                self._told("moved")
                self.settled()
            else:
                self._back(kept)
                step, growth = _SHRINK * step, 1.0

    def _go(
        self, travels: BoolArray, aim: FloatArray, moment_nmm: FloatArray | float = 0.0, *, downhill: bool = False
    ) -> bool:
        """Find equilibrium at travels (mm) along some of the plate's axes, and under forces (N) along the others.

        A plate that turns freely also takes up a moment (3,), N mm. ``downhill`` is by `fe.descent`: under forces
        alone, and a plate that does not turn.
        """
        contact = self.contact
        contact.begin(self.state)
        equations = self.assembler.own_equations + np.arange(3)
        outside = np.zeros(self.assembler.size)
        outside[equations] = np.where(travels, 0.0, aim)
        self.assembler.share(contact.followers)
        if downhill:
            found = self._descended(outside)
        else:
            turning = None
            if contact.hold.loose:
                turning = Turning(contact, self.assembler, self.solver, np.broadcast_to(moment_nmm, 3))
            found = equilibrium(
                self.assembler,
                self.solver,
                self.state,
                outside,
                equations[travels],
                (aim - self.plate.travel_mm)[travels],
                self.tolerance,
                self._changed,
                self.tell,
                turning,
            )
        if found is None:
            return False
        travel = contact.travel_mm(found.state)
        if np.abs(travel - [contact.plate.gap_mm, 0.0, 0.0]).max() > self.extent_mm:
            self.tell("the plate would have moved farther than the body is large")
            return False
        self.state = found.state
        self.iterations += found.iterations
        self.plate = PlateState(
            travel,
            contact.force_n(found.forces),
            np.degrees(Rotation.from_matrix(contact.hold.rotation).as_rotvec()),
            contact.moment_nmm(found.state, found.forces),
            self._area_mm2(),
        )
        self.curve.append(self.plate)
        return True

    def _descended(self, outside: FloatArray) -> Converged | None:
        """Equilibrium under forces; what touches on the way does so from where it was the step before."""

        def changed(state: FloatArray, forces: FloatArray) -> bool:
            touched = self._changed(state, forces)
            self.contact.begin(state)
            return touched

        return descend(
            self.assembler, self.solver, self.state, outside, self.tolerance, changed, self.tell, self.extent_mm,
            self.over,
        )  # fmt: skip

    def _area_mm2(self) -> float:
        """Area of the faces of which every corner holds to the plate, as they are now."""
        u = self.state[: 3 * len(self.model.space.nodes_mm)].reshape(-1, 3)
        faces = self._faces[np.isin(self._faces, self.contact.held).all(axis=1)]
        a, b, c = np.moveaxis((self.model.space.nodes_mm + u)[faces], 1, 0)
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    def _changed(self, state: FloatArray, forces: FloatArray) -> bool:
        if not self.contact.update(state, forces):
            return False
        self.assembler.share(self.contact.followers)
        return True

    @property
    def standing(self) -> Standing:
        """Where it is now."""
        return Standing(self.state, self.plate, self.contact.hold)

    def stand(self, where: Standing) -> None:
        """Go to where it, or another on the same model, has been before; the curve stays as it is."""
        self.state, self.plate, self.contact.hold = where.unknowns, where.plate, where.hold

    def _back(self, where: Standing) -> None:
        """Take steps back that were made since."""
        while self.curve[-1] is not where.plate:
            self.curve.pop()
        self.stand(where)

    def _told(self, what: str) -> None:
        plate = self.plate
        travel, force, turn = (
            ", ".join(f"{v:.3f}" for v in x) for x in (plate.travel_mm, plate.force_n, plate.turn_deg)
        )
        turned = f", turned {turn} degrees" if self.contact.hold.loose else ""
        self.tell(f"{what}: travel {travel} mm, force {force} N, {len(self.contact.held)} nodes on the plate{turned}")


def _nodes_on(model: Model, mesh: TetMesh, facets: str) -> IntArray:
    """Displacement nodes on named facets; those in the middle of edges too."""
    corners = np.unique(mesh.facets[facets])
    if model.element.name != "P2":
        return corners
    return np.union1d(corners, model.space.middles(edges_of(mesh.facets[facets])))
