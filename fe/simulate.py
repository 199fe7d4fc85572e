"""The experiment: a plate pressed and then sheared against tissue on fixed bone, load after load on one path."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError
from dvc.mesh import TetMesh
from fe.assembly import Assembler, Model
from fe.elements import element
from fe.linear import Solver
from fe.materials import Material
from fe.newton import Tolerance, equilibrium
from fe.plate import Contact, Plate

BONE, SURFACE = "bone", "skin"
"""Names of the facets that are fixed, and of those that the plate may touch."""

_FIRST_STEP = 0.25
_LEAST_STEP = 1.0 / 512.0
_GROWTH, _SHRINK = 1.7, 0.4
_APPROACH_MM = 0.25
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
        Share of the way from the load before it; 1 where all of it is there.
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
        Travel and force of every state of equilibrium on the way from the load before it, this one last.
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
        With facets "bone", which do not move, and "skin", which the plate may touch; every cell in one region.
    laws : mapping of region to Material
    plate : Plate
    loads : sequence of LoadStep
        Reached one from the other. The first must press.
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
    _check(mesh, laws, loads)
    turned = TetMesh(mesh.points_mm @ plate.axes, mesh.cells, mesh.regions, mesh.facets)
    model = Model.of(turned, laws, element(formulation))
    path = _Path(model, turned, plate, threads, tell)
    states: list[State] = []
    try:
        path.approach(loads[0].normal_n)
        progress(0.3 / len(loads))
        before = path.force.copy()
        for number, load in enumerate(loads):
            first = 0.3 if number == 0 else 0.0
            target = np.array([load.normal_n, load.shear_n, 0.0])
            began, counted, known = time.monotonic(), path.iterations if states else 0, len(path.curve) if states else 0

            def told(share: float, done: int = number, first: float = first) -> None:
                progress((done + first + (1.0 - first) * share) / len(loads))

            reached = path.raise_force(before, target, told)
            displacements = 3 * len(model.space.nodes_mm)
            u = path.state[:displacements].reshape(-1, 3)[: len(mesh.points_mm)]
            states.append(
                State(
                    load=load,
                    reached=reached,
                    u_mm=u @ plate.axes.T,
                    pressure_mpa=path.state[displacements:][model.space.pressure_cells],
                    gradients=plate.axes @ model.gradients(path.state) @ plate.axes.T,
                    travel_mm=path.travel.copy(),
                    force_n=path.force.copy(),
                    on_plate=path.on_plate[path.on_plate < len(mesh.points_mm)],
                    curve=np.reshape(path.curve[known:], (-1, 6)),
                    iterations=path.iterations - counted,
                    seconds=time.monotonic() - began,
                )
            )
            keep(states[-1])
            if reached < 1.0:
                break
            before = target
    finally:
        path.solver.close()
    return states


def _check(mesh: TetMesh, laws: Mapping[str, Material], loads: Sequence[LoadStep]) -> None:
    for name in (BONE, SURFACE):
        if name not in mesh.facets:
            raise InputError(
                f"The mesh has no facets '{name}'; it has {', '.join(mesh.facets) or 'none'}. The bone's interface is "
                f"called '{BONE}' and is fixed, the surface that the plate touches '{SURFACE}'."
            )
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
    if not loads:
        raise InputError("No load is given.")
    for load in loads:
        if not (np.isfinite([load.normal_n, load.shear_n]).all() and load.normal_n > 0.0):
            raise InputError(
                f"{load.name}: the normal force must press, above 0 N; got {load.normal_n:g} N. The plate's normal "
                "points away from the tissue."
            )


_Kept = tuple[FloatArray, FloatArray, FloatArray, BoolArray, int]


class _Path:
    """The state on its way, and what moves it."""

    def __init__(self, model: Model, mesh: TetMesh, plate: Plate, threads: int, tell: Callable[[str], None]) -> None:
        self.model, self.tell = model, tell
        on_bone, on_surface = (_nodes_on(model, mesh, name) for name in (BONE, SURFACE))
        touching = np.setdiff1d(on_surface, on_bone)
        self.contact = Contact(plate, model.space.nodes_mm, touching)
        fixed = (3 * on_bone[:, None] + np.arange(3)).ravel()
        self.assembler = Assembler(model, fixed, self.contact.may_follow)
        self.solver = Solver(self.assembler.indptr, self.assembler.indices, threads=threads)
        self.state = np.zeros(model.unknowns)
        self.travel, self.force = np.zeros(3), np.zeros(3)
        self.curve: list[FloatArray] = []
        self.tolerance = Tolerance()
        self.iterations = 0

    @property
    def on_plate(self) -> IntArray:
        """Displacement nodes that hold to the plate."""
        return self.contact.nodes[self.contact.holds]

    def approach(self, normal_n: float) -> None:
        """Move the plate from its first touch on, until it presses with a part of the force asked for."""
        self.contact.touch_first(self.state)
        self.travel[0] = self.contact.plate.gap_mm
        step = _APPROACH_MM
        while self.force[0] < _ENOUGH * normal_n and step > _LEAST_APPROACH_MM:
            kept = self._kept()
            if self._go(np.zeros(3), [0], np.array([step])) and self.force[0] < normal_n:
                step *= _GROWTH
                self._told("moved")
            else:
                self._restore(kept)
                step *= _SHRINK

    def raise_force(self, before: FloatArray, target: FloatArray, progress: Callable[[float], None]) -> float:
        """Raise the force from what it is to the target, in steps as large as converge; the share reached."""
        done, step = 0.0, _FIRST_STEP
        while done < 1.0 and step > _LEAST_STEP:
            share = min(1.0, done + step)
            kept = self._kept()
            if self._go(before + share * (target - before), [], np.zeros(0)):
                done, step = share, step * _GROWTH
                self._told(f"{done:.0%} of the way")
                progress(done)
            else:
                self._restore(kept)
                step *= _SHRINK
        return done

    def _go(self, force: FloatArray, held: list[int], moves: FloatArray) -> bool:
        """Find equilibrium under a force along the axes that are not held, and moves along those that are."""
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
        for axis, unknowns in follows.items():
            self.travel[axis] += found.state[unknowns[0]] - self.state[unknowns[0]]
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
    from fe.elements import EDGES

    faces = mesh.facets[facets]
    ends = np.sort(np.concatenate([faces[:, pair] for pair in ([0, 1], [0, 2], [1, 2])]), axis=1)
    of_cells = np.sort(np.concatenate([mesh.cells[:, list(edge)] for edge in EDGES]), axis=1)
    middles = model.space.cells[:, 4:].T.ravel()
    count = len(mesh.points_mm)
    wanted = np.isin(of_cells[:, 0] * count + of_cells[:, 1], ends[:, 0] * count + ends[:, 1])
    return np.union1d(corners, middles[wanted])
