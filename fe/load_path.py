"""Load paths: a plate pressed against tissue in a sequence of loads and converged increments."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

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
_APPROACH_MM, _MOST_APPROACH_MM = 0.25, 1.0
_MOST_OTHERWISE_MM = 0.6  # under displacement control, and with a plate that rotates: 1.0 is less exact (decision 7)
_LEAST_APPROACH_MM = 0.01
# With a material whose stiffness is far from every published one, or whose stress falls, and below this fraction of the
# normal load: least steps, of a stage and mm. Where they fail, smaller ones and viscous descent took minutes to fail.
_EARLY, _LEAST_DOUBTED, _LEAST_DOUBTED_MM = 0.5, 1.0 / 32.0, 0.1
_ALONG_NORMAL = np.array([True, False, False])
# Fraction of the normal load up to which the plate is displacement controlled, so that nodes touch it in order. A plate
# that rotates is released at the first fraction at which it does not tip over, once enough nodes touch.
_ENOUGH, _RELEASED = 0.8, (0.2, 0.4, 0.6, 0.8)
_AIM = 0.9  # of the normal load, for the last step on the way there
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
            else:
                self._push(share * target.values[0], target.values[0])
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
            self._log(f"{1.0 - left:.0%} released")
        if left > 0.0:
            self._back(level)
        return left == 0.0

    def press(self, target: PlateTarget) -> bool:
        """Continue to the normal load, in one step if the approach has come near; whether it is reached."""
        free = self.contact.plate.turns or target.displaced[0]
        near = not free and self.plate.force_n[0] >= _ENOUGH * target.values[0]
        return self.raise_to(target.unsheared(), 1.0 if near else _FIRST_STEP)

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
            if self._go(target.displaced, before + share * way, downhill=downhill):
                done, step = share, step if downhill else step * _GROWTH
                self._log(f"{done:.0%} of this stage")
                self.on_converged()
                continue
            step *= _SHRINK
            if self._hopeless(self.reached(target)[0], target.values[0]) and step < min(_LEAST_DOUBTED, 0.15 * largest):
                break
            stays = self.contact.plate.taped and not self.contact.status.turns
            # if Newton's method fails under force control, viscous descent takes over
            if step < _SOFT_STEP and stays and not (downhill or target.displaced.any()):
                downhill, step = True, _DOWNHILL_STEP
        return done >= 1.0

    def _push(self, enough_n: float, most_n: float) -> None:
        """Move the plate along its normal until its force is ``enough_n`` or cannot rise; never above ``most_n``."""
        farthest = self.plate.displacement_mm[0] + float(np.ptp(self.model.space.nodes_mm[:, 0]))
        largest, exact = self._most_mm, self.tolerance
        rough = replace(exact, force=_ROUGH_FORCE * exact.force, step_mm=_ROUGH_STEP * exact.step_mm)
        while self.plate.force_n[0] < enough_n and largest > _LEAST_APPROACH_MM and not self.is_over():
            step = min(largest, self._to_next_stop(), self._to_force(_AIM * most_n))
            if farthest - self.plate.displacement_mm[0] < step:
                break
            last = self.increment
            aim = np.array([self.plate.displacement_mm[0] + step, 0.0, 0.0])
            converged = self._go(_ALONG_NORMAL, aim, tolerance=rough)
            if converged and self.plate.force_n[0] < most_n:
                self._log("moved")
                self.on_converged()
                continue
            self._back(last)
            largest = _SHRINK * step
            if not converged and largest < _LEAST_DOUBTED_MM and self._hopeless(self.plate.force_n[0], most_n):
                break

    def _hopeless(self, reached: float, normal: float) -> bool:
        """Whether no smaller step is tried after one that failed: far from the normal load, with a doubted material."""
        return self._doubted and reached < _EARLY * normal

    def _to_force(self, force_n: float) -> float:
        """Step of the approach to a force, mm, if the force goes on to grow by the same factor with each mm."""
        before, now = self.curve[-2:] if len(self.curve) > 1 else 2 * self.curve
        moved_mm = now.displacement_mm[0] - before.displacement_mm[0]
        if not (force_n > now.force_n[0] > before.force_n[0] > 0.0 and moved_mm > _LEAST_APPROACH_MM):
            return np.inf
        rates = np.log([now.force_n[0] / before.force_n[0], force_n / now.force_n[0]])
        return float(moved_mm * rates[1] / rates[0])

    @property
    def _most_mm(self) -> float:
        """Longest step of the approach under force control, mm."""
        return _MOST_OTHERWISE_MM if self.contact.plate.turns else _MOST_APPROACH_MM

    def _to_next_stop(self) -> float:
        """Step of the approach, mm; unless steps have failed, it has the same stops wherever it is resumed."""
        moved_mm = self.plate.displacement_mm[0] - self._start_mm[0]
        stop, step = 0.0, _APPROACH_MM
        while stop < moved_mm + _LEAST_APPROACH_MM:
            stop, step = stop + step, min(_GROWTH * step, self._most_mm)
        return float(stop - moved_mm)

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


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """State from which a simulation continues: the end of a load, or a converged increment within it.

    Attributes
    ----------
    reached : float
        Fraction of the change from the previous load that is reached, 1 at the end of the load. If the load changes
        several axes, that of the axis where it is smallest.
    stages : int
        Completed stages of the load; for the first load of a path, the approach of the plate is one.
    curve : tuple of PlateState
        State of the plate at every converged increment, from that of the previous load to this one.
    iterations : int
        Newton iterations since the previous load, without those of failed increments; those of loads that are passed
        count, as they do in ``curve`` and ``seconds``.
    unknowns : (unknowns,)
        Displacements, along the plate's axes, and pressures.
    """

    reached: float
    stages: int
    curve: tuple[PlateState, ...]
    iterations: int
    seconds: float
    unknowns: FloatArray
    contact: ContactStatus


class Loading:
    """A load in progress, which starts from the end of the previous load of its path.

    ``before`` is the target of the previous load, None for the first load, which starts with the approach. ``earlier``
    is the checkpoint of this load in an earlier solution. ``on_converged`` is called at each converged increment with a
    checkpoint and the fraction done.
    """

    def __init__(
        self, path: LoadPath, target: PlateTarget, before: PlateTarget | None, earlier: Checkpoint | None,
        on_converged: Callable[[Checkpoint, float], None],
    ) -> None:  # fmt: skip
        self._path, self._target, self._first = path, target, before is None
        self._before = path.reached(target)
        if before is not None:  # the target itself, not the values reached within the tolerance
            self._before = np.where(target.displaced == before.displaced, before.values, self._before)
        self._began, self._counted = time.monotonic() - (earlier.seconds if earlier else 0.0), path.iterations
        self._stages, self._complete = 0, False
        path.solver.forget()  # so that a load depends only on its start, not on earlier solutions
        path.assembler.forget()
        path.curve = path.curve[-1:]
        if earlier is not None:
            path.curve = list(earlier.curve)
            path.resume((earlier.unknowns, earlier.curve[-1], earlier.contact))
            self._stages, self._counted = earlier.stages, path.iterations - earlier.iterations
        if before is None:  # from the first touch, whatever it passes
            self._before = np.where(target.displaced, path.curve[0].displacement_mm, path.curve[0].force_n)
        path.on_converged = lambda: on_converged(self.checkpoint(), float(np.clip(self._shares(), 0.0, 1.0).mean()))

    def run(self) -> bool:
        """Load up to the target, normal first, then shear; whether it is reached."""
        path, target = self._path, self._target
        stages = [partial(path.raise_to, target)]
        if self._first:
            stages = [partial(path.approach, target), partial(path.press, target), *(stages if target.sheared else [])]
        for stage in stages[self._stages :]:
            if not stage():
                return False
            self._stages += 1
        self._complete = True
        return True

    def checkpoint(self) -> Checkpoint:
        """Checkpoint of the current state."""
        path = self._path
        reached = 1.0 if self._complete else max(0.0, float(self._shares().min(initial=1.0)))
        return Checkpoint(
            reached, self._stages, tuple(path.curve), path.iterations - self._counted,
            time.monotonic() - self._began, path.state, path.contact.status,
        )  # fmt: skip

    def _shares(self) -> FloatArray:
        """Fraction reached of the load's change, along each of the plate's axes that it changes."""
        way = self._target.values - self._before
        adds = way != 0.0
        if not adds.any():
            return np.ones(1)
        return np.asarray((self._path.reached(self._target) - self._before)[adds] / way[adds])
