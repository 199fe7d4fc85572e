"""Problems with one input changed, and their solutions from the state of the unchanged problem.

An input changes by one standard uncertainty. From the converged state of a load, the changed problem needs few Newton
iterations, and the contact is the same; the difference of the two solutions is then smooth.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.arrays import FloatArray, IntArray
from dvc.errors import InputError, MrstrainError
from dvc.mesh import faces_of, signed_volumes
from fe.hyperelastic import OGDEN
from fe.loading import Checkpoint
from fe.materials import HIGHEST_NU, Material, Materials
from fe.mesh_file import BONE, SKIN
from fe.plate import Plate
from fe.problem import LoadStep, Problem
from fe.solution import LoadState, Observer, SolverOptions, solve

_LEAST_VOLUME, _LEAST_SHARE = 0.2, 0.1  # of a cell whose nodes are moved, over its own; of the way that they move


def with_force(load: LoadStep, relative: float, newton: float = 0.0) -> LoadStep:
    """A load whose forces are larger by one standard uncertainty, with a relative and an absolute part (N).

    The two parts are combined as the root of the sum of squares. Prescribed plate displacements and forces of zero are
    unchanged.
    """

    def larger(force: float | None) -> float | None:
        return force + np.sign(force) * float(np.hypot(relative * force, newton)) if force else force

    return replace(load, normal_n=larger(load.normal_n), shear_n=larger(load.shear_n))


def tilted(plate: Plate, degrees: float, *, along: bool) -> Plate:
    """A plate whose normal and direction of shear are tilted, ``along`` the direction of shear or across it."""
    axes = plate.axes  # normal force, shear, third
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axes[:, 2 if along else 1]).as_matrix()
    return replace(plate, normal=-turn @ axes[:, 0], shear=turn @ axes[:, 1])


def with_compressibility(materials: Materials, relative: float) -> dict[str, Material]:
    """Materials whose 0.5 - nu is larger by a relative standard uncertainty."""
    return {
        region: replace(law, nu=float(np.clip(0.5 - (1.0 + relative) * (0.5 - law.nu), 0.0, HIGHEST_NU)))
        for region, law in materials.items()
    }


def with_stiffness(materials: Materials, region: str, relative: float) -> dict[str, Material]:
    """Materials with one region stiffer by a relative standard uncertainty, at every strain."""
    if region not in materials:
        raise InputError(f"The mesh has no region '{region}', whose stiffness is uncertain; it has {list(materials)}.")
    law, vector = materials[region], materials[region].vector.copy()
    vector[:OGDEN] *= 1.0 + relative
    vector[OGDEN::2] *= 1.0 + relative
    return {**materials, region: replace(law, vector=vector)}


def with_bone(mesh: TetMesh, thickness_mm: float) -> tuple[TetMesh, float]:
    """A mesh whose bone is thicker; nodes move, and cells stay the same.

    Also returns the fraction of the thickness that was reached: less than 1 if cells would have become too flat.
    """
    every = np.arange(len(mesh.cells))
    return _moved(mesh, *_normals(mesh, every, _keys(mesh, mesh.facets[BONE])), -thickness_mm)


def with_tissue(mesh: TetMesh, tissue: str, thickness_mm: float) -> tuple[TetMesh, float]:
    """A mesh in which a tissue (region of this name) is thicker where it meets other tissues; as `with_bone`.

    Surfaces of the bone and of the body stay.
    """
    cells = mesh.regions[tissue]
    others = np.setdiff1d(np.arange(len(mesh.cells)), cells)
    nodes, normals = _normals(mesh, cells, _keys(mesh, faces_of(mesh.cells[others])))
    held = [mesh.facets[name].ravel() for name in (BONE, SKIN) if name in mesh.facets]
    moving = ~np.isin(nodes, np.concatenate(held)) if held else np.ones(len(nodes), dtype=bool)
    if not moving.any():
        raise MrstrainError(f"'{tissue}' has no interface with other tissues inside the mesh that could be shifted.")
    return _moved(mesh, nodes[moving], normals[moving], thickness_mm)


def from_base(
    problem: Problem, base: Mapping[str, Checkpoint], options: SolverOptions | None = None,
    observer: Observer | None = None,
) -> list[LoadState]:  # fmt: skip
    """Solve each load of a changed problem from the state of that load in the unchanged one.

    Mesh topology and axes of the plate must be those of the unchanged problem. Loads without a state are skipped.
    """
    states = []
    for load in problem.loads:
        if (state := base.get(load.name)) is None:
            continue
        last = 2 if load.sheared else 1  # the approach and the normal force are done; the last stage is done again
        start = replace(state, reached=0.0, stages=last, iterations=0, seconds=0.0)
        states += solve(replace(problem, loads=(load,), passed=()), options, observer, {load.name: start})
    return states


def _keys(mesh: TetMesh, faces: IntArray) -> IntArray:
    """A number for each face (k, 3), whatever the order of its nodes."""
    a, b, c = np.sort(faces, axis=1).T
    return np.asarray((a * len(mesh.points_mm) + b) * len(mesh.points_mm) + c)


def _normals(mesh: TetMesh, cells: IntArray, keys: IntArray) -> tuple[IntArray, FloatArray]:
    """Nodes (k,) of those faces of some cells that have these keys, and normals (k, 3) there, out of the cells."""
    summed, at = np.zeros_like(mesh.points_mm), mesh.points_mm
    touched = np.zeros(len(at), dtype=bool)
    for opposite in range(4):
        faces = np.delete(mesh.cells[cells], opposite, axis=1)
        among = np.isin(_keys(mesh, faces), keys)
        faces, tip = faces[among], at[mesh.cells[cells[among], opposite]]
        a, b, c = (at[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal *= np.sign(np.einsum("ij,ij->i", normal, a - tip))[:, None]
        for corner in range(3):
            np.add.at(summed, faces[:, corner], normal)
        touched[faces.ravel()] = True
    nodes = np.flatnonzero(touched)
    return nodes, summed[nodes] / np.maximum(np.linalg.norm(summed[nodes], axis=1, keepdims=True), 1e-12)


def _moved(mesh: TetMesh, nodes: IntArray, normals: FloatArray, distance_mm: float) -> tuple[TetMesh, float]:
    """A mesh with nodes moved along normals, and those inside tissues smoothly between; all other boundaries stay."""
    count, pairs = len(mesh.points_mm), np.concatenate([mesh.cells[:, [i, j]] for i in range(4) for j in range(i)])
    one = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    joined = ((one + one.T) > 0).astype(np.float64)
    laplace = (sparse.diags(np.asarray(joined.sum(axis=1)).ravel()) - joined).tocsc()
    step = np.zeros((count, 3))
    step[nodes] = distance_mm * normals
    regions = np.zeros(count, dtype=np.int64)  # that a node belongs to
    for cells in mesh.regions.values():
        regions[np.unique(mesh.cells[cells])] += 1
    still = np.concatenate([np.flatnonzero(regions > 1), *(rows.ravel() for rows in mesh.facets.values())])
    free = np.setdiff1d(np.arange(count), np.union1d(nodes, still))
    if len(free):
        inner = laplace[free]
        step[free] = spsolve(inner[:, free], -(inner @ step)).reshape(-1, 3)
    before, share = np.abs(mesh.volumes_mm3), 1.0
    while share > _LEAST_SHARE:
        points = mesh.points_mm + share * step
        if (signed_volumes(points[mesh.cells]) > _LEAST_VOLUME * before).all():
            return TetMesh(points, mesh.cells, mesh.regions, mesh.facets), share
        share *= 0.5
    raise MrstrainError(
        f"Cells at a tissue interface are too flat to shift the interface by {abs(distance_mm):.3g} mm. Use a finer "
        "mesh, or set labels_voxels = 0 in [uncertainty]."
    )
