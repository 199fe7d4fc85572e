"""Solution of a problem: the loads of one path in sequence, and the final state of each load."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from dvc import StrainField, TetMesh
from dvc.arguments import checked
from dvc.arrays import FloatArray, IntArray
from dvc.memory import hand_memory_back
from fe.elements import Model, element
from fe.load_path import LoadPath, PlateState
from fe.loading import Checkpoint, Loading
from fe.newton import Tolerance
from fe.problem import LoadStep, Problem


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """Options of the solver.

    Attributes
    ----------
    threads : int
        Of the linear algebra.
    limit_s : float
        Time after which a load path ends at its last converged increment, s. A Newton iteration that is in progress is
        completed, a viscous descent is not.
    tolerance : Tolerance
        Convergence criterion of an increment.
    """

    threads: int = 1
    limit_s: float = np.inf
    tolerance: Tolerance = field(default_factory=Tolerance)


class Observer:
    """Receives the progress of a solution; this base class ignores it.

    Derive your own class, override the methods that you need, and give it to `solve` or `simulate`.
    """

    def log(self, line: str) -> None:
        """Called with a line of text for each step."""

    def progress(self, done: float) -> None:
        """Called with the fraction of all loads that is done, 0 to 1."""

    def converged(self, load: LoadStep, checkpoint: Checkpoint) -> None:
        """Called at a converged increment of a load, with the checkpoint from which it can be resumed."""

    def ended(self, state: "LoadState") -> None:
        """Called with the final state of a load."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadState:
    """The last converged increment of a load; vectors in LPS, except those of the plate.

    Attributes
    ----------
    reached, curve, iterations, seconds
        As in `fe.Checkpoint`; the curve is empty without a plate.
    u_mm : (n, 3)
        Displacement of the mesh's nodes, mm.
    pressure_mpa : (m,)
        Mean pressure in each cell, positive in tension, MPa.
    gradients : (m, 3, 3)
        H = du/dX of each cell, reference configuration; the mean over the cell if it varies there.
    on_plate : (k,)
        Nodes in contact with the plate.
    checkpoint : Checkpoint, optional
        State from which the next load continues.
    out_of_time : bool
        Whether the load ended because the time limit was reached.
    plate_axes : (3, 3), optional
        Axes of the plate's vectors, LPS. Columns: the directions of the normal force, of shear, and their cross product
        at the start.
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
        """Force of the plate on the tissue (3,), N, along its axes at the start; the support force is opposite."""
        return self.plate.force_n

    @property
    def strain(self) -> StrainField:
        """Strain of the cells."""
        return StrainField.from_gradient(self.gradients)


@checked
def solve(
    problem: Problem, options: SolverOptions | None = None, observer: Observer | None = None,
    earlier: Mapping[str, Checkpoint] = MappingProxyType({}),
) -> list[LoadState]:  # fmt: skip
    """Press and shear soft tissue with a rigid plate, along one load path.

    Parameters
    ----------
    options, observer : optional
        Threads, time limit and tolerance; and the observer that receives the progress.
    earlier : mapping of load name to Checkpoint
        From an earlier solution of the same problem: of the first loads, or of those that are passed. A complete load
        is not solved again, an incomplete one is continued.

    Returns
    -------
    list of LoadState
        One for each load, without those that are passed. A load that cannot be reached is the last in the list, with
        its last converged increment and ``reached`` below 1. It is empty if a load that is passed cannot be reached.
    """
    options, observer = options or SolverOptions(), observer or Observer()
    mesh, axes = problem.mesh, problem.plate.axes
    passed = () if problem.loads[0].name in earlier else tuple(problem.passed)
    passed = passed[max((n for n, load in enumerate(passed) if load.name in earlier), default=0) :]
    loads = (*passed, *problem.loads)
    turned = TetMesh(mesh.points_mm @ axes, mesh.cells, mesh.regions, mesh.facets)
    model = Model.of(turned, problem.materials, element(problem.element))
    deadline = time.monotonic() + options.limit_s
    path = LoadPath(
        model, turned, problem, options.threads, options.tolerance, observer.log, (lambda: time.monotonic() > deadline)
    )
    u_count, node_count = 3 * len(model.space.nodes_mm), len(mesh.points_mm)
    states: list[LoadState] = []
    before: Checkpoint | None = None
    try:
        for number, load in enumerate(loads):
            own = number >= len(passed)

            def on_converged(
                checkpoint: Checkpoint, done: float, number: int = number, load: LoadStep = load, own: bool = own
            ) -> None:
                observer.progress((number + done) / len(loads))
                if own:
                    observer.converged(load, checkpoint)

            known = earlier.get(load.name)
            if before is not None and not states and known is None:  # the load that it passes is an increment of it
                known = replace(before, stages=0)
            loading = Loading(path, load.target, states[-1].load.target if states else None, known, on_converged)
            complete = loading.run()
            observer.progress((number + 1.0) / len(loads))
            before, held = loading.checkpoint(), path.contact.held
            if own:
                at = before
                state = LoadState(
                    load, at.reached, at.unknowns[:u_count].reshape(-1, 3)[:node_count] @ axes.T,
                    model.pressures(at.unknowns).mean(axis=1), axes @ model.gradients(at.unknowns) @ axes.T,
                    held[held < node_count], at.curve, at.iterations, at.seconds, at, not complete and path.is_over(),
                    axes,
                )  # fmt: skip
                states.append(state)
                observer.ended(state)
            if not complete:
                break
    finally:
        path.solver.close()
    return states


def solve_paths(
    problems: Sequence[Problem], options: SolverOptions | None = None, observer: Observer | None = None
) -> list[LoadState]:
    """Solve all load paths of `fe.problems_of`, in their order; a load that several of them pass is solved once.

    A path is not tried if a load that it passes is not reached.
    """
    known: dict[str, LoadState] = {}
    for one in sorted(problems, key=lambda problem: len(problem.passed)):
        if all(load.name in known and known[load.name].reached == 1.0 for load in one.passed):
            earlier = {load.name: at for load in one.passed if (at := known[load.name].checkpoint)}
            known |= {state.load.name: state for state in solve(one, options, observer, earlier)}
            hand_memory_back()
    names = [load.name for one in problems for load in one.loads]
    return [known[name] for name in names if name in known]
