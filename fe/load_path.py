"""Load paths: a plate pressed against tissue in a sequence of loads and converged increments."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.arrays import BoolArray, FloatArray
from fe.assembly import Assembler
from fe.descent import descend
from fe.elements import Model
from fe.linear import Solver
from fe.mesh_file import SKIN
from fe.newton import Imposed, Tolerance, equilibrium
from fe.plate import Contact, ContactStatus, Parallel, Turning
from fe.problem import PlateTarget, Problem
from fe.published import doubts

_FIRST_STEP = 0.25
_LEAST_STEP, _SOFT_STEP = 1.0 / 512.0, 1.0 / 32.0
_TIPPING = 0.5  # fraction of the parallel plate's indentation: a released plate above it has tipped over
_DOWNHILL_STEP, _LEAST_DOWNHILL_STEP = 0.1, 1.0 / 128.0
_GROWTH, _SHRINK = 1.7, 0.4
# Steps of a plate that is moved along the normal, and along the shear. If only shorter ones converge, its force is
# raised instead, with the help of viscous descent.
_FIRST_MM, _MOST_MM, _LEAST_MM = (0.25, 1.0), (1.0, 3.0), (0.01, 0.25)
_MOST_OTHERWISE_MM = 0.6  # under displacement control, and with a plate that rotates: 1.0 is less exact (decision 7)
_CLOSE_MM = 0.01
# With a material whose stiffness is far from every published one, or whose stress falls, and below this fraction of the
# normal load: least steps, of a stage and mm, how many may be left to the load once a step has failed, and iterations
# of a step. Smaller and more steps, more iterations, and forces after displacements have failed, took minutes to fail.
_EARLY, _LEAST_DOUBTED, _LEAST_DOUBTED_MM, _MOST_DOUBTED, _DOUBTED_ITERATIONS = 0.5, 1.0 / 32.0, 0.1, 50, 15
# Fraction of a force up to which the plate is displacement controlled, so that nodes touch it in order. A plate that
# rotates is released at the first fraction at which it does not tip over, once enough nodes touch.
_ENOUGH, _RELEASED = 0.8, (0.2, 0.4, 0.6, 0.8)
_AIM = 0.9  # of the force, for the last step on the way there
_LEAST_KNOWN = (0.0, 0.01)  # of the force along an axis, from which on its growth is known
_PRESSED = 0.01  # of the normal force, by which it may be off where the plate is sheared by displacing it
_ROUGH_FORCE, _ROUGH_STEP = 10.0, 30.0  # factors on the tolerance of increments on the way there


@dataclass(frozen=True, slots=True, eq=False)
class PlateState:
    """State of a plate in equilibrium; vectors along its axes at the start.

    Attributes
    ----------
    displacement_mm : (3,)
        Of the pivot, from its start.
    force_n : (3,)
        On the tissue.
    turn_deg : (3,)
        Rotation vector: axis times angle.
    moment_nmm : (3,)
        On the tissue, about the pivot.
    area_mm2 : float
        Deformed contact area: that of faces with all corners on the plate.
    """

    displacement_mm: FloatArray
    force_n: FloatArray
    turn_deg: FloatArray
    moment_nmm: FloatArray
    area_mm2: float

    @property
    def pressure_mpa(self) -> float:
        """Mean contact pressure: normal force over area; NaN if no whole face is in contact."""
        return float(self.force_n[0]) / self.area_mm2 if self.area_mm2 > 0.0 else float("nan")


_Increment = tuple[FloatArray, PlateState, ContactStatus]  # a converged one, with the unknowns of `Checkpoint`


class LoadPath:
    """The body under an increasing load, increment by increment; vectors and ``mesh`` are along the plate's axes.

    ``curve`` is the state of the plate at every converged increment so far. ``log`` is called with a line for each
    step, ``is_over`` returns whether to stop, and ``on_converged`` is called at each increment that can be resumed.
    """

    def __init__(
        self, model: Model, mesh: TetMesh, problem: Problem, threads: int, tolerance: Tolerance,
        log: Callable[[str], None], is_over: Callable[[], bool],
    ) -> None:  # fmt: skip
        self.model, self.tolerance, self.log, self.is_over = model, tolerance, log, is_over
        self.on_converged: Callable[[], None] = lambda: None
        held = model.space.nodes_on(np.concatenate([mesh.facets[name] for name in problem.fixed]))
        touching = np.setdiff1d(model.space.nodes_on(mesh.facets[SKIN]), held)
        self.contact = Contact(problem.plate, model.space.nodes_mm, touching)
        may_follow = {axis: 3 * touching + axis for axis in range(3)}
        self.assembler = Assembler(model, (3 * held[:, None] + np.arange(3)).ravel(), may_follow)
        self.solver = Solver(self.assembler.indptr, self.assembler.indices, threads=threads)
        self.extent_mm = float(np.ptp(model.space.nodes_mm, axis=0).max())
        self.state = np.zeros(model.unknowns)
        self._faces, self._start_mm = mesh.facets[SKIN], np.array([problem.plate.gap_mm, 0.0, 0.0])
        self.plate = PlateState(self._start_mm, np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
        self.curve = [self.plate]
        self.iterations = 0
        self._doubted = bool(doubts("", problem.materials))

    def reached(self, target: PlateTarget) -> FloatArray:
        """Current values (3,) of the quantities that a target prescribes."""
        return np.where(target.displaced, self.plate.displacement_mm, self.plate.force_n)

    def approach(self, target: PlateTarget) -> bool:
        """Make contact, press to a fraction of the normal load, and release a rotating plate; whether to continue."""
        if not len(self.contact.held):
            self.contact.touch_first(self.state)
        for share in _RELEASED if self.contact.plate.turns else (_ENOUGH,):
            if target.displaced[0]:
                way = target.values - self._start_mm
                part = PlateTarget(self._start_mm + share * way, target.displaced).unsheared()
                if part.values[0] > self.plate.displacement_mm[0] and not self.raise_to(part):
                    return False
            elif not self._move(0, target.unsheared(), share):
                return False
            if self.is_over():
                return False
            if not self.contact.plate.turns or self._let_go():
                return True
        return False

    def _let_go(self) -> bool:
        """Remove the moment that kept the plate parallel, at constant force; False if the plate tips over."""
        level, force, moment = self.increment, self.plate.force_n, self.plate.moment_nmm
        self.contact.status = replace(self.contact.status, turns=True)
        gap_mm, left, step = self.contact.plate.gap_mm, 1.0, 0.5
        least_mm = gap_mm + _TIPPING * (self.plate.displacement_mm[0] - gap_mm)
        while left > 0.0 and step > _LEAST_STEP and not self.is_over():
            least = max(0.0, left - step)
            if not self._go(np.zeros(3, dtype=bool), force, least * moment):
                step *= _SHRINK
                continue
            if self.plate.displacement_mm[0] < least_mm:
                break
            left, step = least, step * _GROWTH
            self._log(f"{100 * (1.0 - left):.0f} % released")
        if left > 0.0:
            self._back(level)
        return left == 0.0

    def press(self, target: PlateTarget) -> bool:
        """Continue to the normal load; whether it is reached."""
        free = self.contact.plate.turns or target.displaced[0]
        return self.raise_to(target.unsheared(), _FIRST_STEP if free else self._last_step(0, target))

    def shear(self, target: PlateTarget) -> bool:
        """Continue to the shear, to a force by displacing the plate unless it rotates; whether it is reached."""
        (normal, shear, _), (normal_n, shear_n, _) = self.plate.force_n, target.values
        pressed, grows = abs(normal - normal_n) <= _PRESSED * abs(normal_n), shear_n * (shear_n - shear) > 0.0
        if self.contact.plate.turns or target.displaced.any() or not (pressed and grows):
            return self.raise_to(target)
        return self._move(1, target, _ENOUGH) and self.raise_to(target, self._last_step(1, target))

    def _last_step(self, axis: int, target: PlateTarget) -> float:
        """First step to a force, as a fraction: the whole way where the displaced plate has come near."""
        return 1.0 if self.plate.force_n[axis] / target.values[axis] >= _ENOUGH else _FIRST_STEP

    def raise_to(self, target: PlateTarget, first: float = _FIRST_STEP) -> bool:
        """Continue to the target, in steps as large as converge, the first a given fraction; whether it is reached."""
        before = self.reached(target)
        way = target.values - before  # displacement steps are small, so that nodes come into contact in order
        largest = _MOST_OTHERWISE_MM / max(float(np.abs(way[target.displaced]).max(initial=0.0)), 1e-12)
        done, step, downhill = 0.0, first, False
        least = min(_LEAST_STEP, 0.01 * largest)
        while done < 1.0 and step > (_LEAST_DOWNHILL_STEP if downhill else least) and not self.is_over():
            step = min(step, largest)
            share = min(1.0, done + step)
            tolerance = self._tolerance(self.tolerance, self.reached(target)[0], target.values[0])
            if self._go(target.displaced, before + share * way, downhill=downhill, tolerance=tolerance):
                done, step = share, step if downhill else step * _GROWTH
                self._log(f"{100 * done:.0f} % of this stage")
                self.on_converged()
                continue
            step *= _SHRINK
            cut_short = self._cut_short(self.reached(target)[0], target.values[0])
            if cut_short and step < min(_LEAST_DOUBTED, 0.15 * largest):
                break
            stays = self.contact.plate.taped and not self.contact.status.turns
            # if Newton's method fails under force control, viscous descent takes over
            if step < _SOFT_STEP and stays and not (downhill or target.displaced.any()):
                downhill, step = True, _DOWNHILL_STEP
        return done >= 1.0

    def _move(self, axis: int, target: PlateTarget, share: float) -> bool:
        """Displace the plate along an axis until its force is a fraction of the target's, or cannot rise; never above.

        Along the other axes it has the forces of the target. False if the search was cut short.
        """
        aim_n = float(target.values[axis])
        ahead = 1.0 if aim_n > 0.0 else -1.0
        farthest = self._moved(axis, ahead) + float(np.ptp(self.model.space.nodes_mm[:, axis]))
        largest, exact = _MOST_OTHERWISE_MM if self.contact.plate.turns else _MOST_MM[axis], self.tolerance
        rough = replace(exact, force=_ROUGH_FORCE * exact.force, step_mm=_ROUGH_STEP * exact.step_mm)
        most = largest
        while (
            ahead * self.plate.force_n[axis] < share * abs(aim_n) and largest > _LEAST_MM[axis] and not self.is_over()
        ):
            moved_mm = self._moved(axis, ahead)
            step = min(largest, _to_next_stop(moved_mm, _FIRST_MM[axis], most), self._to_force(axis, _AIM * aim_n))
            if farthest - moved_mm < step:
                break
            last, aim = self.increment, target.values.copy()
            aim[axis] = self._start_mm[axis] + ahead * (moved_mm + step)
            tolerance = self._tolerance(rough, self.plate.force_n[0], target.values[0])
            converged = self._go(np.arange(3) == axis, aim, tolerance=tolerance)
            # Beyond the largest shear force that tissue carries, no state is on the way.
            rises = axis == 0 or ahead * (self.plate.force_n[axis] - last[1].force_n[axis]) > 0.0
            if converged and rises and ahead * self.plate.force_n[axis] < abs(aim_n):
                self._log(("moved", "sheared")[axis])
                self.on_converged()
                continue
            self._back(last)
            largest = _SHRINK * step
            if not converged and self._cut_short(self.plate.force_n[0], target.values[0]):
                left = self._to_force(axis, _AIM * aim_n) / largest
                if largest < _LEAST_DOUBTED_MM or _MOST_DOUBTED < left < np.inf:
                    return self.contact.plate.turns
        return True

    def _moved(self, axis: int, ahead: float) -> float:
        """Displacement of the plate along an axis, or against it, since it touched the tissue, mm."""
        return ahead * float(self.plate.displacement_mm[axis] - self._start_mm[axis])

    def _cut_short(self, reached: float, normal: float) -> bool:
        """Whether the search for equilibrium is cut short: far below the normal load, with a doubted material."""
        return self._doubted and reached < _EARLY * normal

    def _tolerance(self, tolerance: Tolerance, reached: float, normal: float) -> Tolerance:
        """The tolerance of a step; where the search is cut short and the plate keeps parallel, with few iterations."""
        if self.contact.plate.turns or not self._cut_short(reached, normal):
            return tolerance
        return replace(tolerance, iterations=min(tolerance.iterations, _DOUBTED_ITERATIONS))

    def _to_force(self, axis: int, force_n: float) -> float:
        """Step along an axis to a force, mm, if the force goes on to grow by the same factor with each mm."""
        ends = self.curve[-2:] if len(self.curve) > 1 else 2 * self.curve
        before, now = (end.force_n[axis] / force_n for end in ends)
        moved_mm = abs(ends[1].displacement_mm[axis] - ends[0].displacement_mm[axis])
        grows = _LEAST_KNOWN[axis] < before < now < 1.0 and moved_mm > _CLOSE_MM
        return float(moved_mm * np.log(now) / np.log(before / now)) if grows else np.inf

    def _go(
        self, displaced: BoolArray, aim: FloatArray, moment_nmm: FloatArray | float = 0.0, *, downhill: bool = False,
        tolerance: Tolerance | None = None,
    ) -> bool:  # fmt: skip
        """Find equilibrium with displacements (mm) along some of the plate's axes and forces (N) along the others.

        A freely rotating plate also gets a moment (3,), N mm. ``downhill`` uses `fe.descent`, which needs forces along
        all axes and a plate that does not rotate. If no equilibrium is found, the state is restored.
        """
        contact, before, tolerance = self.contact, self.contact.status, tolerance or self.tolerance
        contact.begin(self.state)
        equations = self.assembler.own_equations + np.arange(3)
        outside = np.zeros(self.assembler.size)
        outside[equations] = np.where(displaced, 0.0, aim)
        self.assembler.share(contact.followers)

        def changed(state: FloatArray, forces: FloatArray) -> bool:
            if touched := contact.update(state, forces):
                self.assembler.share(contact.followers)
            if downhill:  # the next contacts start from the current state
                contact.begin(state)
            return touched

        system = self.assembler, self.solver, self.state
        if downhill:
            converged = descend(*system, outside, tolerance, changed, self.log, self.is_over)
        else:
            rotation = Parallel()
            if contact.status.turns:
                rotation = Turning(contact, self.assembler, self.solver, np.broadcast_to(moment_nmm, 3))
            imposed = Imposed(outside, equations[displaced], (aim - self.plate.displacement_mm)[displaced])
            converged = equilibrium(*system, imposed, tolerance, changed, self.log, rotation)
        if converged and np.abs(contact.displacement_mm(converged.state) - self._start_mm).max() > self.extent_mm:
            self.log("rejected: the plate would have moved by more than the size of the body")
            converged = None
        if converged is None:
            contact.status = before
            return False
        self.state = converged.state
        self.iterations += converged.iterations
        u = self.state[: 3 * len(self.model.space.nodes_mm)].reshape(-1, 3)
        faces = self._faces[np.isin(self._faces, contact.held).all(axis=1)]  # all corners on the plate
        a, b, c = np.moveaxis((self.model.space.nodes_mm + u)[faces], 1, 0)
        area_mm2 = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
        self.plate = PlateState(
            contact.displacement_mm(self.state), contact.force_n(converged.forces),
            np.degrees(Rotation.from_matrix(contact.status.rotation).as_rotvec()),
            contact.moment_nmm(self.state, converged.forces), area_mm2,
        )  # fmt: skip
        self.curve.append(self.plate)
        return True

    @property
    def increment(self) -> _Increment:
        """The current increment."""
        return self.state, self.plate, self.contact.status

    def resume(self, where: _Increment) -> None:
        """Go to an increment of this path, or of another path on the same model; the curve does not change."""
        self.state, self.plate, self.contact.status = where

    def _back(self, where: _Increment) -> None:
        """Undo the steps since an increment."""
        while self.curve[-1] is not where[1]:
            self.curve.pop()
        self.resume(where)

    def _log(self, what: str) -> None:
        at, nodes = self.plate, len(self.contact.held)
        moved, force, turn = (", ".join(f"{v:.3f}" for v in x) for x in (at.displacement_mm, at.force_n, at.turn_deg))
        turned = f", rotation {turn} degrees" if self.contact.status.turns else ""
        self.log(f"{what}: displacement {moved} mm, force {force} N, {nodes} nodes on the plate{turned}")


def _to_next_stop(moved_mm: float, first_mm: float, most_mm: float) -> float:
    """Step of a plate that has moved, mm; unless steps have failed, it has the same stops wherever it is resumed."""
    stop, step = 0.0, first_mm
    while stop < moved_mm + _CLOSE_MM:
        stop, step = stop + step, min(_GROWTH * step, most_mm)
    return float(stop - moved_mm)
