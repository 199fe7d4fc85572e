"""The experiment: a plate pressed and then sheared against tissue on fixed bone, load after load on one path."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError
from dvc.mesh import TetMesh
from fe.assembly import Assembler
from fe.elements import edges_of, element
from fe.linear import Solver
from fe.materials import Material
from fe.model import Model
from fe.newton import Tolerance, equilibrium
from fe.plate import Contact, Plate

BONE, SURFACE = "bone", "skin"
"""Names of the facets that are fixed, and of those that the plate may touch."""

_FIRST_STEP = 0.25
_LEAST_STEP, _SOFT_STEP = 1.0 / 512.0, 1.0 / 32.0
_GROWTH, _SHRINK = 1.7, 0.4
_APPROACH_MM, _MOST_APPROACH_MM = 0.25, 0.6
_LEAST_APPROACH_MM = 0.01
_ENOUGH = 0.2  # share of the normal force up to which the plate is moved, and not yet pushed


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load to be reached from the one before it.

    Attributes
    ----------
    name : str
    normal_n, shear_n : float
        Force of the plate on the tissue along the normal force's and the shear's direction, N.
    """

    name: str
    normal_n: float
    shear_n: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Equilibrium under a load; vectors in LPS but for those of the plate.

    Attributes
    ----------
    load : LoadStep
    reached : float
        Share of the force that this load adds to the one before it on its path, all of it being 1.
    u_mm : (n, 3)
        Displacement of the mesh's nodes, mm.
    pressure_mpa : (m, 4)
        Pressure at the corners of each cell, positive in tension.
    gradients : (m, 3, 3)
        H = du/dX of each cell, its mean where the element's varies.
    travel_mm, force_n : (3,)
        Displacement of the plate from its start, and its force on the tissue, along the plate's axes.
    on_plate : (k,)
        Nodes that hold to the plate.
    curve : (k, 6)
        Travel and force of every state of equilibrium on the way, from that of the load before it to this one.
    iterations : int
        Newton steps since the load before it, those of steps that failed not counted.
    seconds : float
    """

    load: LoadStep
    reached: float
    u_mm: FloatArray
    pressure_mpa: FloatArray
    gradients: FloatArray
    travel_mm: FloatArray
    force_n: FloatArray
    on_plate: IntArray
    curve: FloatArray
    iterations: int
    seconds: float


def simulate(
    mesh: TetMesh,
    laws: Mapping[str, Material],
    plate: Plate,
    loads: Sequence[LoadStep],
    *,
    fixed: Sequence[str] = (BONE,),
    formulation: str = "P1",
    threads: int = 1,
    keep: Callable[[State], None] = lambda _: None,
    progress: Callable[[float], None] = lambda _: None,
    tell: Callable[[str], None] = lambda _: None,
) -> list[State]:
    """Press and shear soft tissue with a rigid plate.

    Parameters
    ----------
    mesh : TetMesh
        With facets "skin", which the plate may touch, and those that are fixed; every cell in one region.
    laws : mapping of region to Material
    plate : Plate
    loads : sequence of LoadStep
        Reached one from the other. The first must press.
    fixed : sequence of str
        Facets that do not move.
    formulation : {"P1", "MINI", "P2"}
        As in `fe.elements`.
    threads : int
        Of the linear algebra.
    keep : callable
        Gets each load's state as soon as it is there.
    progress : callable
        Gets the share of all loads that is done.
    tell : callable
        Gets a line for each step.

    Returns
    -------
    list of State
        One for each load; where one cannot be reached, the last that was in equilibrium, ``reached`` below 1, ends it.

    Raises
    ------
    InputError
        If a region has no law or a cell no region, the facets are missing, or the first load does not press.
    """
    check(mesh, laws, plate, loads, fixed)
    turned = TetMesh(mesh.points_mm @ plate.axes, mesh.cells, mesh.regions, mesh.facets)
    model = Model.of(turned, laws, element(formulation))
    path = _Path(model, turned, plate, fixed, threads, tell)
    states: list[State] = []
    before = np.zeros(3)
    try:
        for number, load in enumerate(loads):
            target = np.array([load.normal_n, load.shear_n, 0.0])
            began, counted, known = time.monotonic(), path.iterations, len(path.curve)

            def told(share: float, done: int = number) -> None:
                progress((done + share) / len(loads))

            whole = True
            if not states:
                path.approach(load.normal_n)
                if load.shear_n != 0.0:  # normal first, then shear
                    whole = path.raise_force(np.array([load.normal_n, 0.0, 0.0]), told)
            whole = whole and path.raise_force(target, told)
            reached = (
                1.0 if whole else float((path.force - before) @ (target - before) / ((target - before) ** 2).sum())
            )
            displacements = 3 * len(model.space.nodes_mm)
            u = path.state[:displacements].reshape(-1, 3)[: len(mesh.points_mm)]
            states.append(
                State(
                    load=load,
                    reached=reached,
                    u_mm=u @ plate.axes.T,
                    pressure_mpa=model.pressures(path.state),
                    gradients=plate.axes @ model.gradients(path.state) @ plate.axes.T,
                    travel_mm=path.travel.copy(),
                    force_n=path.force.copy(),
                    on_plate=path.on_plate[path.on_plate < len(mesh.points_mm)],
                    curve=np.array(path.curve[known - 1 :]),
                    iterations=path.iterations - counted,
                    seconds=time.monotonic() - began,
                )
            )
            keep(states[-1])
            if not whole:
                break
            before = target
    finally:
        path.solver.close()
    return states


def check(
    mesh: TetMesh,
    laws: Mapping[str, Material],
    plate: Plate,
    loads: Sequence[LoadStep],
    fixed: Sequence[str] = (BONE,),
) -> None:
    """Refuse what `simulate` cannot do, before anything is computed; errors as there."""
    if not fixed:
        raise InputError("No facets are fixed: tissue that nothing holds cannot be pressed.")
    for name in (*fixed, SURFACE):
        if name not in mesh.facets:
            raise InputError(
                f"The mesh has no facets '{name}'; it has {', '.join(mesh.facets) or 'none'}. The bone's interface is "
                f"called '{BONE}' and is fixed, the surface that the plate touches '{SURFACE}'."
            )
    check_laws(mesh, laws)
    if not loads:
        raise InputError("No load is given.")
    for load in loads:
        if not (np.isfinite([load.normal_n, load.shear_n]).all() and load.normal_n > 0.0):
            raise InputError(
                f"{load.name}: the normal force must press, above 0 N; got {load.normal_n:g} N. The plate's normal "
                "points away from the tissue."
            )
        if load.shear_n != 0.0 and not plate.taped:
            raise InputError(f"{load.name}: a plate without friction carries no shear force; got {load.shear_n:g} N.")
    _check_held(mesh, fixed)
    on_surface = np.setdiff1d(np.unique(mesh.facets[SURFACE]), _nodes_of(mesh, fixed))
    Contact(plate, mesh.points_mm @ plate.axes, on_surface)


def check_laws(mesh: TetMesh, laws: Mapping[str, Material]) -> None:
    """Refuse a mesh of which a cell has no law, or more than one."""
    times = np.zeros(len(mesh.cells), dtype=int)
    for region in laws:
        if region not in mesh.regions:
            raise InputError(f"The mesh has no region '{region}'; it has {', '.join(mesh.regions) or 'none'}.")
        times[mesh.regions[region]] += 1
    if (times != 1).any():
        bare, twice = int((times == 0).sum()), int((times > 1).sum())
        without = ", ".join(name for name in mesh.regions if name not in laws)
        raise InputError(
            f"Every cell needs one law: {bare} have none and {twice} more than one. Regions without a law: "
            f"{without or 'none'}."
        )


def _nodes_of(mesh: TetMesh, facets: Sequence[str]) -> IntArray:
    return np.unique(np.concatenate([mesh.facets[name].ravel() for name in facets]))


def _check_held(mesh: TetMesh, fixed: Sequence[str]) -> None:
    """Refuse tissue that hangs on nothing: cells whose nodes are joined to no fixed one."""
    ends = np.repeat(mesh.cells[:, 0], 3), mesh.cells[:, 1:].ravel()
    count = len(mesh.points_mm)
    joined = sparse.csr_matrix((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(count, count))
    _, part = connected_components(joined, directed=False)
    loose = ~np.isin(part[mesh.cells[:, 0]], part[_nodes_of(mesh, fixed)])
    if loose.any():
        raise InputError(
            f"{int(loose.sum())} of {len(loose)} cells are not joined to what is fixed ({', '.join(fixed)}): tissues "
            "are bonded where they share nodes. Merge coincident nodes where the mesh was made."
        )


_Kept = tuple[FloatArray, FloatArray, FloatArray, BoolArray, int]


class _Path:
    """The state on its way, and what moves it."""

    def __init__(
        self,
        model: Model,
        mesh: TetMesh,
        plate: Plate,
        fixed: Sequence[str],
        threads: int,
        tell: Callable[[str], None],
    ) -> None:
        self.model, self.tell = model, tell
        held = np.unique(np.concatenate([_nodes_on(model, mesh, name) for name in fixed]))
        touching = np.setdiff1d(_nodes_on(model, mesh, SURFACE), held)
        self.contact = Contact(plate, model.space.nodes_mm, touching)
        self.assembler = Assembler(model, (3 * held[:, None] + np.arange(3)).ravel(), self.contact.may_follow)
        self.solver = Solver(self.assembler.indptr, self.assembler.indices, threads=threads)
        self.state = np.zeros(model.unknowns)
        self.extent_mm = float(np.ptp(model.space.nodes_mm, axis=0).max())
        self.travel, self.force = np.zeros(3), np.zeros(3)
        self.travel[0] = plate.gap_mm
        self.curve: list[FloatArray] = [np.concatenate([self.travel, self.force])]
        self.tolerance = Tolerance()
        self.iterations = 0

    @property
    def on_plate(self) -> IntArray:
        """Displacement nodes that hold to the plate."""
        return self.contact.nodes[self.contact.holds]

    def approach(self, normal_n: float) -> None:
        """Move the plate from its first touch on, until it presses with a part of the force asked for."""
        self.contact.touch_first(self.state)
        self._push(0, _ENOUGH * normal_n, normal_n)

    def raise_force(self, target: FloatArray, progress: Callable[[float], None]) -> bool:
        """Raise the force from what it is to the target, in steps as large as converge; whether it is there.

        Where tissue gives way too much for that, the plate is moved along the force for a while, and then pushed again.
        It is given up where the plate has moved as far as the body is large.
        """
        before, way = self.force.copy(), target - self.force
        axis = int(np.argmax(np.abs(way)))
        done, step, pushed = 0.0, _FIRST_STEP, False
        while done < 1.0 and step > _LEAST_STEP:
            share = min(1.0, done + step)
            kept = self._kept()
            if self._go(before + share * way, [], np.zeros(0)):
                done, step, pushed = share, step * _GROWTH, False
                self._told(f"{done:.0%} of the way")
                progress(done)
                continue
            self._restore(kept)
            step *= _SHRINK
            if step < _SOFT_STEP and not pushed:
                pushed = True
                self._push(axis, before[axis] + min(1.0, done + _FIRST_STEP) * way[axis], target[axis])
                done, step = float((self.force - before) @ way / (way @ way)), _FIRST_STEP
        return done >= 1.0

    def _push(self, axis: int, enough_n: float, most_n: float) -> None:
        """Move the plate along an axis until its force there is enough, or no more can be had; never past the most."""
        sign = 1.0 if most_n >= self.force[axis] else -1.0
        farthest = self.travel[axis] + sign * float(np.ptp(self.model.space.nodes_mm[:, 0]))
        step = _APPROACH_MM
        while sign * (enough_n - self.force[axis]) > 0.0 and step > _LEAST_APPROACH_MM:
            if sign * (farthest - self.travel[axis]) < step:
                break
            kept = self._kept()
            if self._go(self.force, [axis], np.array([sign * step])) and sign * (most_n - self.force[axis]) > 0.0:
                step = min(_GROWTH * step, _MOST_APPROACH_MM)
                self._told("moved")
            else:
                self._restore(kept)
                step *= _SHRINK

    def _go(self, force: FloatArray, held: list[int], moves: FloatArray) -> bool:
        """Find equilibrium under a force along the axes that are not held, and moves along those that are."""
        self.contact.begin(self.state)
        follows = self.contact.followers
        plate = self.assembler.own_equations + np.arange(3)
        outside = np.zeros(self.assembler.size)
        outside[plate] = force
        self.assembler.share(follows)
        found = equilibrium(
            self.assembler,
            self.solver,
            self.state,
            outside,
            plate[held],
            moves,
            self.tolerance,
            self._changed,
            self.tell,
        )
        if found is None:
            return False
        self.travel[0] = self.contact.plate.gap_mm + self.contact.advance_mm(found.state)
        if self.contact.plate.taped:  # whoever was on the plate still is
            for axis in (1, 2):
                self.travel[axis] += (found.state - self.state)[follows[axis][0]]
        if np.abs(self.travel - [self.contact.plate.gap_mm, 0.0, 0.0]).max() > self.extent_mm:
            self.tell("the plate would have moved farther than the body is large")
            return False
        self.force = np.array([found.forces[self.contact.followers.get(axis, [])].sum() for axis in range(3)])
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
        return self.state, self.travel.copy(), self.force, self.contact.holds, len(self.curve)

    def _restore(self, kept: _Kept) -> None:
        self.state, self.travel, self.force, self.contact.holds, known = kept
        del self.curve[known:]

    def _told(self, what: str) -> None:
        travel, force = (", ".join(f"{v:.3f}" for v in vector) for vector in (self.travel, self.force))
        self.tell(f"{what}: travel {travel} mm, force {force} N, {int(self.contact.holds.sum())} nodes on the plate")


def _nodes_on(model: Model, mesh: TetMesh, facets: str) -> IntArray:
    """Displacement nodes on named facets; those in the middle of edges too."""
    corners = np.unique(mesh.facets[facets])
    if model.element.name != "P2":
        return corners
    return np.union1d(corners, model.space.middles(edges_of(mesh.facets[facets])))
