"""The boundary value problem: tissue under a rigid plate, with what it is made of and where it is held."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from dvc import TetMesh
from dvc.arrays import IntArray
from dvc.errors import InputError
from fe.elements import element as formulation
from fe.load_step import LoadStep, paths_of
from fe.materials import Materials
from fe.plate import Contact, Plate
from fe.surface_sets import BONE, SKIN


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Soft tissue that a rigid plate presses and shears, along one path of loads.

    Attributes
    ----------
    mesh, plate, fixed, element
        As in `fe.simulate`, with one plate; every cell of the mesh is in one region.
    materials : mapping of region to Material
    loads : sequence of LoadStep
        Reached one from the other. The first must press.

    Raises
    ------
    InputError
        If an argument is of another kind, such as a file's path in place of a mesh; if a region has no material or a
        cell no region, a surface set is missing, tissue is joined to nothing that is fixed, the plate comes from the
        wrong side, or a load cannot be brought onto tissue.
    """

    mesh: TetMesh
    materials: Materials
    plate: Plate
    loads: Sequence[LoadStep]
    fixed: Sequence[str] = (BONE,)
    element: str = "P1"

    def __post_init__(self) -> None:
        formulation(self.element)
        mesh, fixed = self.mesh, self.fixed
        check_kinds(mesh, self.plate, self.loads)
        if not fixed:
            raise InputError("No surface set is fixed: tissue that nothing holds cannot be pressed.")
        for name in (*fixed, SKIN):
            if name not in mesh.facets:
                raise InputError(
                    f"The mesh has no facets '{name}'; it has {', '.join(mesh.facets) or 'none'}. The bone's interface "
                    f"is called '{BONE}' and is fixed, the surface that the plate touches '{SKIN}'."
                )
        check_materials(mesh, self.materials)
        check_loads(self.plate, self.loads)
        held = np.unique(np.concatenate([mesh.facets[name].ravel() for name in fixed]))
        _check_bonded(mesh, held, fixed)
        on_surface = np.setdiff1d(np.unique(mesh.facets[SKIN]), held)
        if not len(on_surface):
            raise InputError(f"All of '{SKIN}' is fixed ({', '.join(fixed)}): the plate has nothing to touch.")
        Contact(self.plate, mesh.points_mm @ self.plate.axes, on_surface)


def problems_of(
    mesh: TetMesh, materials: Materials, plate: Plate | Mapping[str, Plate], loads: Sequence[LoadStep],
    fixed: Sequence[str] = (BONE,), element: str = "P1",
) -> list[Problem]:  # fmt: skip
    """A problem for each path that the loads lie on (`fe.paths_of`); ``plate`` may be one for each load, by its name.

    Raises
    ------
    InputError
        As `Problem`, or if a load has no plate.
    """
    check_kinds(mesh, plate, loads)
    plate_of = {load.name: plate if isinstance(plate, Plate) else plate[load.name] for load in loads}
    paths = paths_of(loads, {name: tuple(one.axes.round(9).ravel()) for name, one in plate_of.items()})
    return [Problem(mesh, materials, plate_of[path[0].name], path, fixed, element) for path in paths]


def check_kinds(mesh: object, plate: object, loads: Any) -> None:
    """Refuse what is no mesh, plate or sequence of loads with an `InputError` that says what to give."""
    _expect(TetMesh, mesh, "The mesh must be a TetMesh, as fe.read_tet_mesh(path) or fe.mesh_labels gives it")
    _expect(Sequence, loads, "The loads must be a list of fe.LoadStep")
    for load in loads:
        _expect(LoadStep, load, "The loads must be a list of fe.LoadStep")
        one = plate.get(load.name) if isinstance(plate, Mapping) else plate
        _expect(Plate, one, f"{load.name}: the plate must be an fe.Plate, or a dict with one for each load's name")


def _expect(kind: type, given: object, wanted: str) -> None:
    if not isinstance(given, kind):
        got = "nothing" if given is None else f"{given!r}" if isinstance(given, str) else f"a {type(given).__name__}"
        raise InputError(f"{wanted}; got {got}.")


def check_loads(plate: Plate, loads: Sequence[LoadStep]) -> None:
    """Refuse loads that a plate cannot bring onto tissue, with an `InputError`."""
    if not loads:
        raise InputError("No load is given.")
    for load in loads:
        value, displaced = load.target.values[0], load.target.displaced[0]
        least, kind = (plate.gap_mm, "displacement") if displaced else (0.0, "force")
        if not (np.isfinite(load.target.values).all() and value > least):
            above = f"{least:g} mm, the gap" if displaced else "0 N"
            raise InputError(
                f"{load.name}: the normal {kind} must press, above {above}; got {load}. The plate's normal points away "
                "from the tissue."
            )
        if load.sheared and not plate.taped:
            raise InputError(f"{load.name}: a plate without friction carries no shear; got {load}.")


def check_materials(mesh: TetMesh, materials: Materials) -> None:
    """Refuse a mesh of which a cell has no material, or more than one, with an `InputError`."""
    _expect(Mapping, materials, "Materials must be a dict of region to material, as MaterialSet.for_regions gives it")
    times = np.zeros(len(mesh.cells), dtype=int)
    for region in materials:
        if region not in mesh.regions:
            raise InputError(f"The mesh has no region '{region}'; it has {', '.join(mesh.regions) or 'none'}.")
        times[mesh.regions[region]] += 1
    if (times != 1).any():
        bare, twice = int((times == 0).sum()), int((times > 1).sum())
        without = ", ".join(name for name in mesh.regions if name not in materials)
        raise InputError(
            f"Every cell needs one material law: {bare} have none and {twice} more than one. Regions without one: "
            f"{without or 'none'}."
        )


def _check_bonded(mesh: TetMesh, held: IntArray, fixed: Sequence[str]) -> None:
    """Refuse tissue that nothing holds: cells whose nodes are joined to no fixed one."""
    ends = np.repeat(mesh.cells[:, 0], 3), mesh.cells[:, 1:].ravel()
    count = len(mesh.points_mm)
    joined = sparse.csr_matrix((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(count, count))
    _, part = connected_components(joined, directed=False)
    loose = ~np.isin(part[mesh.cells[:, 0]], part[held])
    if loose.any():
        raise InputError(
            f"{int(loose.sum())} of {len(loose)} cells are not joined to what is fixed ({', '.join(fixed)}): tissues "
            "are bonded where they share nodes. Merge coincident nodes where the mesh was made."
        )
