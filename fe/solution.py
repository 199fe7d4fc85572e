"""A problem solved: load after load on one path, and the equilibrium that each of them ends in."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dvc import StrainField, TetMesh
from dvc.arguments import checked
from dvc.arrays import FloatArray, IntArray
from fe.elements import Model, element
from fe.load_path import Checkpoint, Loading, LoadPath, PlateState
from fe.newton import Tolerance
from fe.problem import LoadStep, Problem


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """How a problem is solved.

    Attributes
    ----------
    threads : int
        Of the linear algebra.
    limit_s : float
        Time after which a path of loads ends at its last converged increment, s; a viscous step that is under way is
        not finished, one of Newton's is.
    tolerance : Tolerance
        When an increment counts as converged.
    """

    threads: int = 1
    limit_s: float = np.inf
    tolerance: Tolerance = field(default_factory=Tolerance)


class Observer:
    """Receives the progress of a solution; this one does nothing with it.

    Derive a class of your own, with the methods that are of interest, and give it to `solve` or `simulate`.
    """

    def log(self, line: str) -> None:
        """Take a line for each step."""

    def progress(self, done: float) -> None:
        """Take the share of all loads that is done, 0 to 1."""

    def converged(self, load: LoadStep, checkpoint: Checkpoint) -> None:
        """Take what it takes to resume from a converged increment on the way to a load."""

    def ended(self, state: "LoadState") -> None:
        """Take the state in which a load ended."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadState:
    """The last converged increment of a load; vectors in LPS but for those of the plate.

    Attributes
    ----------
    reached, curve, iterations, seconds
        As in `fe.Checkpoint`; the curve is empty where there is no plate.
    u_mm : (n, 3)
        Displacement of the mesh's nodes, mm.
    pressure_mpa : (m,)
        Mean pressure in each cell, positive in tension, MPa.
    gradients : (m, 3, 3)
        H = du/dX of each cell, reference configuration; its mean where the element's varies.
    on_plate : (k,)
        Nodes in contact with the plate.
    checkpoint : Checkpoint, optional
        What the next load goes on from.
    out_of_time : bool
        Whether it ended because its time was over.
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
    checkpoint: Checkpoint | None = None
    out_of_time: bool = False
    plate_axes: FloatArray | None = None

    @property
    def plate(self) -> PlateState:
        """The plate under this load."""
        return self.curve[-1]

    @property
    def plate_displacement_mm(self) -> FloatArray:
        """Displacement of the plate (3,) from its start, mm, along its axes at the start."""
        return self.plate.displacement_mm

    @property
    def force_n(self) -> FloatArray:
        """Force of the plate on the tissue (3,), N, along its axes at the start; that of what is fixed is opposite."""
        return self.plate.force_n

    @property
    def strain(self) -> StrainField:
        """Strain of the cells."""
        return StrainField.from_gradient(self.gradients)


@checked
def solve(
    problem: Problem, options: SolverOptions | None = None, observer: Observer | None = None,
    earlier: Sequence[Checkpoint] = (),
) -> list[LoadState]:  # fmt: skip
    """Press and shear soft tissue with a rigid plate, along one path of loads.

    Parameters
    ----------
    options, observer : optional
        Threads, time limit and tolerance; what receives the progress.
    earlier : sequence of Checkpoint
        Of the first loads, from an earlier solution of the same problem: they are not solved again. The last may have
        been on its way.

    Returns
    -------
    list of LoadState
        One for each load. One that cannot be reached ends the list, with its last converged increment and ``reached``
        below 1.
    """
    options, observer = options or SolverOptions(), observer or Observer()
    mesh, loads, axes = problem.mesh, problem.loads, problem.plate.axes
    turned = TetMesh(mesh.points_mm @ axes, mesh.cells, mesh.regions, mesh.facets)
    model = Model.of(turned, problem.materials, element(problem.element))
    deadline = time.monotonic() + options.limit_s
    path = LoadPath(
        model, turned, problem, options.threads, options.tolerance, observer.log, (lambda: time.monotonic() > deadline)
    )
    u_count, node_count = 3 * len(model.space.nodes_mm), len(mesh.points_mm)
    states: list[LoadState] = []
    try:
        for number, load in enumerate(loads):

            def on_converged(checkpoint: Checkpoint, done: float, number: int = number, load: LoadStep = load) -> None:
                observer.progress((number + done) / len(loads))
                observer.converged(load, checkpoint)

            before = states[-1].load.target if states else None
            loading = Loading(path, load.target, before, dict(enumerate(earlier)).get(number), on_converged)
            complete = loading.run()
            observer.progress((number + 1.0) / len(loads))
            at, held = loading.checkpoint(), path.contact.held
            state = LoadState(
                load, at.reached, at.unknowns[:u_count].reshape(-1, 3)[:node_count] @ axes.T,
                model.pressures(at.unknowns).mean(axis=1), axes @ model.gradients(at.unknowns) @ axes.T,
                held[held < node_count], at.curve, at.iterations, at.seconds, at, not complete and path.is_over(), axes,
            )  # fmt: skip
            states.append(state)
            observer.ended(state)
            if not complete:
                break
    finally:
        path.solver.close()
    return states
