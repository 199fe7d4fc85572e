"""The experiment: a plate pressed and then sheared against tissue on fixed bone, load after load on one path."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from dvc.arrays import FloatArray, IntArray
from dvc.errors import InputError
from dvc.mesh import TetMesh
from fe.elements import element
from fe.load_stages import Kept, Leg
from fe.materials import Material
from fe.model import Model
from fe.newton import Tolerance
from fe.plate import Contact, Plate
from fe.plate_path import Goal, Path, PlateState
from fe.surface_sets import BONE, SKIN

_TOLERANCE = Tolerance()


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load to be reached from the one before it: along the normal and across it a force, or the plate's travel.

    Attributes
    ----------
    name : str
    normal_n, shear_n : float, optional
        Force of the plate on the tissue along the normal force's and the shear's direction, N.
    normal_mm, shear_mm : float, optional
        In its place, the plate's travel from its start, mm.

    Raises
    ------
    InputError
        If along the normal not just one of the two is given, or along the shear both.
    """

    name: str
    normal_n: float | None = None
    shear_n: float | None = None
    normal_mm: float | None = None
    shear_mm: float | None = None

    def __post_init__(self) -> None:
        if (self.normal_n is None) == (self.normal_mm is None):
            raise InputError(f"{self.name}: give the normal force or the travel along it, and not both.")
        if self.shear_n is not None and self.shear_mm is not None:
            raise InputError(f"{self.name}: give the shear force or the travel along it, and not both.")

    @property
    def sheared(self) -> bool:
        """Whether it asks for a shear, as force or as travel."""
        return self.goal.sheared

    @property
    def goal(self) -> Goal:
        """What it asks of the plate along its three axes."""
        asked = [(self.normal_n, self.normal_mm), (self.shear_n, self.shear_mm), (0.0, None)]
        return Goal(
            np.array([force or 0.0 if travel is None else travel for force, travel in asked]),
            np.array([travel is not None for _, travel in asked]),
        )

    @property
    def told(self) -> str:
        """The load in words, such as "15 N normal, 8 mm shear"."""
        normal, shear, _ = (
            f"{value:g} {'mm' if travel else 'N'}"
            for value, travel in zip(self.goal.values, self.goal.travels, strict=True)
        )
        return f"{normal} normal, {shear} shear"


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Equilibrium under a load; vectors in LPS but for those of the plate.

    Attributes
    ----------
    load : LoadStep
    reached, curve, iterations, seconds
        As in `fe.load_stages.Kept`; the curve is empty where there is no plate.
    u_mm : (n, 3)
        Displacement of the mesh's nodes, mm.
    pressure_mpa : (m, 4)
        Pressure at the corners of each cell, positive in tension.
    gradients : (m, 3, 3)
        H = du/dX of each cell, its mean where the element's varies.
    on_plate : (k,)
        Nodes that hold to the plate.
    kept : Kept, optional
        What the next load goes on from.
    out_of_time : bool
        Whether it ends here because its time was over.
    plate_axes : (3, 3), optional
        Columns: the directions of the normal force, of shear, and their cross product at the start, LPS; those of the
        plate's vectors.
    """

    load: LoadStep
    reached: float
    u_mm: FloatArray
    pressure_mpa: FloatArray
    gradients: FloatArray
    on_plate: IntArray
    curve: tuple[PlateState, ...]
    iterations: int
    seconds: float
    kept: Kept | None = None
    out_of_time: bool = False
    plate_axes: FloatArray | None = None

    @property
    def plate(self) -> PlateState:
        """The plate under this load."""
        return self.curve[-1]

    @property
    def travel_mm(self) -> FloatArray:
        """Displacement of the plate (3,) from its start, along its axes at the start."""
        return self.plate.travel_mm

    @property
    def force_n(self) -> FloatArray:
        """Force of the plate on the tissue (3,), along its axes at the start."""
        return self.plate.force_n


def simulate(
    mesh: TetMesh,
    laws: Mapping[str, Material],
    plate: Plate,
    loads: Sequence[LoadStep],
    *,
    fixed: Sequence[str] = (BONE,),
    formulation: str = "P1",
    threads: int = 1,
    tolerance: Tolerance = _TOLERANCE,
    limit_s: float = np.inf,
    earlier: Sequence[Kept] = (),
    keep: Callable[[State], None] = lambda _: None,
    settled: Callable[[LoadStep, Kept], None] = lambda *_: None,
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
    tolerance : Tolerance
        When a state counts as in equilibrium.
    limit_s : float
        Time after which it ends at the last equilibrium; a step downhill that is under way is not finished, one of
        Newton's is.
    earlier : sequence of Kept
        Of the first loads, from an earlier simulation of the same model, plate and loads: they are not solved again.
        The last may have been on its way.
    keep : callable
        Gets each load's state as soon as it is there.
    settled : callable
        Gets the load and what it takes to go on, at each equilibrium on the way to it.
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
    deadline = time.monotonic() + limit_s
    path = Path(model, turned, plate, fixed, threads, tolerance, tell, lambda: time.monotonic() > deadline)
    states: list[State] = []
    try:
        for number, load in enumerate(loads):

            def stands(kept: Kept, share: float, number: int = number, load: LoadStep = load) -> None:
                progress((number + share) / len(loads))
                settled(load, kept)

            leg = Leg(
                path,
                load.goal,
                states[-1].load.goal if states else None,
                earlier[number] if number < len(earlier) else None,
                stands,
            )
            whole = leg.go()
            kept = leg.kept()
            progress((number + 1.0) / len(loads))
            u = kept.unknowns[: 3 * len(model.space.nodes_mm)].reshape(-1, 3)[: len(mesh.points_mm)]
            held = path.contact.held
            states.append(
                State(
                    load=load,
                    reached=kept.reached,
                    u_mm=u @ plate.axes.T,
                    pressure_mpa=model.pressures(kept.unknowns),
                    gradients=plate.axes @ model.gradients(kept.unknowns) @ plate.axes.T,
                    on_plate=held[held < len(mesh.points_mm)],
                    curve=kept.curve,
                    iterations=kept.iterations,
                    seconds=kept.seconds,
                    kept=kept,
                    out_of_time=not whole and path.over(),
                    plate_axes=plate.axes,
                )
            )
            keep(states[-1])
            if not whole:
                break
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
    for name in (*fixed, SKIN):
        if name not in mesh.facets:
            raise InputError(
                f"The mesh has no facets '{name}'; it has {', '.join(mesh.facets) or 'none'}. The bone's interface is "
                f"called '{BONE}' and is fixed, the surface that the plate touches '{SKIN}'."
            )
    check_laws(mesh, laws)
    check_loads(plate, loads)
    _check_held(mesh, fixed)
    on_surface = np.setdiff1d(np.unique(mesh.facets[SKIN]), _nodes_of(mesh, fixed))
    if not len(on_surface):
        raise InputError(f"All of '{SKIN}' is fixed ({', '.join(fixed)}): the plate has nothing to touch.")
    Contact(plate, mesh.points_mm @ plate.axes, on_surface)


def check_loads(plate: Plate, loads: Sequence[LoadStep]) -> None:
    """Refuse loads that a plate cannot bring onto tissue."""
    if not loads:
        raise InputError("No load is given.")
    for load in loads:
        goal = load.goal
        least = f"{plate.gap_mm:g} mm, the gap" if goal.travels[0] else "0 N"
        if not (np.isfinite(goal.values).all() and goal.values[0] > (plate.gap_mm if goal.travels[0] else 0.0)):
            raise InputError(
                f"{load.name}: the normal {'travel' if goal.travels[0] else 'force'} must press, above {least}; got "
                f"{load.told}. The plate's normal points away from the tissue."
            )
        if load.sheared and not plate.taped:
            raise InputError(f"{load.name}: a plate without friction carries no shear; got {load.told}.")


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
