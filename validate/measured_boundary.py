"""Constitutive models under measured (Dirichlet) boundary conditions: the measured displacement on a mesh's surface.

Bone does not move; every other surface node gets its measured displacement. The interior then depends only on the
constitutive models, not on assumptions about plate, contact and friction.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from dvc import Deformation, TetMesh
from dvc.arguments import checked
from dvc.arrays import FloatArray, IntArray
from dvc.atomic_files import write_whole
from dvc.errors import InputError, MrstrainError
from dvc.io.meshes.read import MM_PER_UNIT, TO_LPS
from dvc.mesh import outer_faces
from fe import BONE, LoadState, LoadStep, Material, Tolerance, check_materials
from fe.assembly import Assembler
from fe.elements import Model, element
from fe.linear import Solver
from fe.newton import Imposed, equilibrium
from validate.mapping import filled_from_nearest

_FIRST_STEP, _LEAST_STEP = 0.25, 1.0 / 64.0
_GROWTH, _SHRINK = 1.7, 0.4
_FAR_MM, _FEW = 3.0, 0.01


def boundary_displacement(mesh: TetMesh, measured: Deformation) -> tuple[IntArray, FloatArray]:
    """Surface nodes (k,) of a mesh, and their measured displacement (k, 3), LPS mm.

    Nodes of the surface set "bone" have zero displacement. A node at which the measurement is undefined (the outermost
    half voxel) takes the value of the nearest node at which it is defined.

    Raises
    ------
    InputError
        If more than 1 % of the nodes are over 3 mm away from the nearest node at which the measurement is defined.
    """
    nodes, u = _boundary(mesh, measured)
    return nodes, u[nodes]


@checked
def _boundary(mesh: TetMesh, measured: Deformation) -> tuple[IntArray, FloatArray]:
    """Surface nodes (k,), and the measured displacement of all nodes (n, 3), zero on the surface of bone."""
    nodes = np.unique(outer_faces(mesh.cells))
    u = measured.displacement(mesh.points_mm)
    known = np.isfinite(u).all(axis=1)
    if not known.any():
        raise InputError(
            "The measurement is not defined at any node of the mesh. Check that both are in the same frame."
        )
    distance, _ = cKDTree(mesh.points_mm[known]).query(mesh.points_mm[~known])
    if (far := np.count_nonzero(distance > _FAR_MM)) > _FEW * len(u):
        raise InputError(
            f"The measurement does not cover the model: {far} of {len(u)} nodes are over {_FAR_MM:g} mm away from the "
            "measured tissue. Check the unit and frame of the mesh."
        )
    u = filled_from_nearest(u, mesh.points_mm)
    if BONE in mesh.facets:
        u[np.intersect1d(nodes, mesh.facets[BONE])] = 0.0
    return nodes, u


def simulate_driven(
    mesh: TetMesh, materials: Mapping[str, Material], measured: Deformation, load: str, *,
    threads: int = 1, tell: Callable[[str], None] = lambda _: None, watch: Callable[[float], None] = lambda _: None,
) -> LoadState:  # fmt: skip
    """Equilibrium of a mesh with the measured displacement prescribed on its surface.

    The state has no plate. If equilibrium is lost, it is the last converged increment, and ``reached`` is below 1.

    Parameters
    ----------
    mesh : TetMesh
        Every cell in one region; the surface set "bone" does not move.
    measured : Deformation
        Of tissue relative to its bone, reference configuration, LPS mm.
    threads, tell : int, callable
        Threads of the linear solver; ``tell`` is called with a line for each increment.
    watch : callable
        Called with the fraction of the displacement that is reached, 0 to 1.

    Raises
    ------
    InputError
        As `boundary_displacement`, or if a cell does not have exactly one constitutive model.
    """
    began = time.monotonic()
    nodes, guess = _boundary(mesh, measured)
    check_materials(mesh, materials)
    model = Model.of(mesh, materials, element("P1"))
    assembler = Assembler(model, (3 * nodes[:, None] + np.arange(3)).ravel(), {})
    solver = Solver(assembler.indptr, assembler.indices, threads=threads)
    state, count = np.zeros(model.unknowns), 3 * len(mesh.points_mm)
    done, step, iterations = 0.0, _FIRST_STEP, 0
    try:
        while done < 1.0 and step > _LEAST_STEP:
            share = min(1.0, done + step)
            tried = state.copy()
            tried[:count] += (share - done) * guess.ravel()
            converged = equilibrium(assembler, solver, tried, Imposed(np.zeros(assembler.size)), Tolerance(), log=tell)
            if converged is None:
                step *= _SHRINK
                continue
            state, done, step = converged.state, share, step * _GROWTH
            iterations += converged.iterations
            tell(f"{100 * done:.0f} % of the displacement")
            watch(done)
    finally:
        solver.close()
    if done == 0.0:
        raise MrstrainError(
            f"{load}: no equilibrium was found with the measured displacement on the surface, not even at the first "
            "increment. Check that the mesh fits the measurement (frame, bone), and has no flat cells at its surface."
        )
    return LoadState(
        load=LoadStep(load, float("nan")), reached=done, u_mm=state[:count].reshape(-1, 3),
        pressure_mpa=model.pressures(state).mean(axis=1), gradients=model.gradients(state),
        on_plate=np.empty(0, dtype=np.int64), curve=(), iterations=iterations, seconds=time.monotonic() - began,
    )  # fmt: skip


def write_boundary_conditions(
    stem: Path, mesh: TetMesh, nodes: IntArray, u_mm: FloatArray, *, unit: str = "mm", frame: str = "LPS"
) -> list[Path]:
    """Write nodal displacements as boundary conditions for other codes, to be merged into a model.

    Parameters
    ----------
    stem : path
        Path of the files without suffix: ``.inp`` is for Abaqus and CalculiX (*BOUNDARY), ``.mac`` for ANSYS (D),
        ``.feb`` for FEBio 4. The paths of the files are returned.
    nodes, u_mm : (k,), (k, 3)
        From `boundary_displacement`, LPS mm. Files use the node numbers of the mesh file or, if it has none, numbers
        from 1, as `fe.write_calculix`.
    unit, frame : {"mm", "m"}, {"LPS", "RAS"}
        Of the mesh file; displacements are written in these.
    """
    numbers = mesh.node_ids[nodes] + (1 if mesh.node_ids.min() == 0 else 0)
    u = u_mm / MM_PER_UNIT[unit] * TO_LPS[frame]
    about = f"displacements of nodes, numbered as in the mesh; unit {unit}, frame {frame}"
    values = [(n, axis, value) for n, row in zip(numbers, u, strict=True) for axis, value in enumerate(row, start=1)]
    abaqus = [f"{n}, {axis}, {axis}, {value:.9g}" for n, axis, value in values]
    ansys = [f"D,{n},U{' XYZ'[axis]},{value:.9g}" for n, axis, value in values]
    files = {
        stem.with_name(f"{stem.name}.inp"): [f"** {about}; insert into a *STEP", "*BOUNDARY", *abaqus],
        stem.with_name(f"{stem.name}.mac"): [f"! {about}", *ansys],
        stem.with_name(f"{stem.name}.feb"): _febio(numbers, u, about),
    }
    for path, lines in files.items():
        write_whole(path, "\n".join(lines) + "\n")
    return list(files)


def _febio(numbers: IntArray, u: FloatArray, about: str) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="ISO-8859-1"?>'
    yield f"<!-- {about} -->"
    yield "<!-- merge into a model in which load controller 1 increases from 0 to 1 -->"
    yield '<febio_spec version="4.0">'
    yield f'<Mesh><NodeSet name="outside">{",".join(map(str, numbers))}</NodeSet></Mesh>'
    yield "<MeshData>"
    for axis, name in enumerate("xyz"):
        yield f'<NodeData name="u{name}" node_set="outside">'
        yield from (f'<node lid="{n}">{value:.9g}</node>' for n, value in enumerate(u[:, axis], start=1))
        yield "</NodeData>"
    yield "</MeshData><Boundary>"
    for name in "xyz":
        yield f'<bc name="outside_{name}" node_set="outside" type="prescribed displacement"><dof>{name}</dof>'
        yield f'<value lc="1" type="map">u{name}</value><relative>0</relative></bc>'
    yield "</Boundary></febio_spec>"
