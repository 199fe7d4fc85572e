"""The boundary value problem: tissue under a rigid plate, its materials, supports and loads."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Self

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from dvc import TetMesh
from dvc.arguments import check_fields, checked
from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError, few
from dvc.file_names import clash, refuse_as_file_name
from dvc.mesh import repeated_rows
from fe.elements import element as formulation
from fe.materials import Materials
from fe.mesh_file import BONE, SKIN, where_open
from fe.plate import Contact, Plate

_MOST_STIFFNESSES = 1000.0  # largest pressure, in shear moduli: free neo-Hookean tissue keeps 3 % of its thickness
_LIQUID_MPA = 1e-6  # shear modulus: 1 cm of tissue as soft sinks by half a metre under its own weight
_UNUSUAL_MPA = 1.0  # peak pressure under the heel of a runner
_SLIGHT_MPA = 5e-5  # the weight of 5 mm of tissue
_SLIGHT = 1e-3  # displacement over the size of the body
_UNITS = 1e3  # between a unit and the one that is typed for it: kN and N, m and mm
_MM2_PER_CM2 = 100.0
_NAMED = 3  # so many repeated cells are named


@dataclass(frozen=True, slots=True, eq=False)
class PlateTarget:
    """Target of the plate along each of its three axes: a force or a displacement."""

    values: FloatArray  # (3,) forces in N, displacements from the plate's start in mm
    displaced: BoolArray  # (3,) axes along which a displacement is prescribed

    @property
    def sheared(self) -> bool:
        """Whether there is a force or a displacement across the normal."""
        return bool(self.values[1:].any() or self.displaced[1:].any())

    def unsheared(self) -> Self:
        """The same target along the normal, without a force across it."""
        return replace(self, values=self.values * [1.0, 0.0, 0.0], displaced=self.displaced & [True, False, False])


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load case: a force or a plate displacement along the normal, and optionally one along the shear.

    Attributes
    ----------
    normal_n, shear_n : float, optional
        Force of the plate on the tissue, N, along the directions of the normal force and of shear.
    normal_mm, shear_mm : float, optional
        Displacement of the plate from its start, mm, instead of the force.

    Raises
    ------
    InputError
        If the name cannot be the name of a file; unless exactly one of force and displacement is given along the
        normal, and at most one along the shear.
    """

    name: str
    normal_n: float | None = None
    shear_n: float | None = None
    normal_mm: float | None = None
    shear_mm: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        refuse_as_file_name("load", self.name)
        if (self.normal_n is None) == (self.normal_mm is None):
            raise InputError(f"{self.name}: give either the normal force or the plate displacement along the normal.")
        if self.shear_n is not None and self.shear_mm is not None:
            raise InputError(f"{self.name}: give either the shear force or the plate displacement along the shear.")

    @property
    def sheared(self) -> bool:
        """Whether there is a shear, as a force or a displacement."""
        return self.target.sheared

    @property
    def target(self) -> PlateTarget:
        """Force or displacement of the plate along its three axes."""
        asked = [(self.normal_n, self.normal_mm), (self.shear_n, self.shear_mm), (0.0, None)]
        return PlateTarget(
            np.array([force or 0.0 if moved is None else moved for force, moved in asked]),
            np.array([moved is not None for _, moved in asked]),
        )

    def __str__(self) -> str:
        """The load as text, such as "15 N normal, 8 mm shear"."""
        target = self.target
        normal, shear, _ = (
            f"{value:g} {'mm' if moved else 'N'}" for value, moved in zip(target.values, target.displaced, strict=True)
        )
        return f"{normal} normal, {shear} shear"


def paths_of(
    loads: Sequence[LoadStep], directions: Mapping[str, Hashable] = MappingProxyType({})
) -> list[tuple[LoadStep, ...]]:
    """Group loads into load paths, each in the order of increasing shear.

    Loads of one path have the same normal force (or displacement), the same sign of the shear, and all a shear force or
    all a shear displacement. A load without shear belongs to the path of the first sheared load with the same normal
    force. ``directions`` gives the directions of loads that have their own; only loads with the same directions are on
    one path.

    Raises
    ------
    InputError
        If there is no load, or two have the same name.

    Examples
    --------
    >>> loads = [LoadStep("Load1", 140.0), LoadStep("Load3", 15.0, 45.0), LoadStep("Load2", 15.0)]
    >>> [" ".join(load.name for load in path) for path in paths_of(loads)]
    ['Load1', 'Load2 Load3']
    """
    if not loads:
        raise InputError("At least one load is needed.")
    if twice := clash(load.name for load in loads):
        raise InputError(f"Two loads are named {twice}; rename one of them.")

    def pressed(load: LoadStep) -> tuple[float, bool, Hashable]:
        return float(load.target.values[0]), bool(load.target.displaced[0]), directions.get(load.name)

    def key(load: LoadStep) -> tuple[Hashable, ...]:
        like = next((x for x in loads if x.sheared and pressed(x) == pressed(load)), load)
        shear = load if load.sheared else like
        return *pressed(load), bool(shear.target.displaced[1]), bool(shear.target.values[1] < 0.0)

    return [
        tuple(sorted((x for x in loads if key(x) == one), key=lambda x: (x.sheared, abs(float(x.target.values[1])))))
        for one in dict.fromkeys(key(load) for load in loads)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Soft tissue that a rigid plate presses and shears, along one load path.

    Attributes
    ----------
    mesh, plate, fixed, element
        As in `fe.simulate`, with one plate; every cell of the mesh is in one region.
    materials : mapping of region to Material
    loads : sequence of LoadStep
        In sequence: each starts from the state of the previous one. The first must press.
    passed : sequence of LoadStep
        Smaller loads without shear that the first load passes, in ascending order; it continues from the last of them.

    Raises
    ------
    InputError
        If an argument has the wrong type, such as a file path in place of a mesh; if a region has no material, a cell
        has no region or is there twice, or a surface set is missing; if tissue is not connected to a fixed surface; if
        the plate comes from the wrong side; or if a load cannot be applied by the plate, passed on the way, or borne by
        any tissue, or if the gap is larger than the body.
    """

    mesh: TetMesh
    materials: Materials
    plate: Plate
    loads: Sequence[LoadStep]
    fixed: Sequence[str] = (BONE,)
    element: str = "P1"
    passed: Sequence[LoadStep] = ()

    def __post_init__(self) -> None:
        formulation(self.element)
        check_fields(self)
        mesh, fixed = self.mesh, self.fixed
        if not fixed:
            raise InputError(f"No surface set is fixed, so the tissue has no support. Fix at least '{BONE}'.")
        for name in (*fixed, SKIN):
            if name not in mesh.facets:
                raise InputError(
                    f"The mesh has no surface set '{name}'; it has {few(mesh.facets, most=4) or 'none'}. Name the "
                    f"interface with bone, which is fixed, '{BONE}', and the surface that the plate touches '{SKIN}'."
                )
        check_materials(mesh, self.materials)
        self.plate.check_gap(float(np.ptp(mesh.points_mm, axis=0).max()))
        check_loads(self.plate, self.loads)
        _check_passed(self.plate, self.loads, self.passed)
        held = np.unique(np.concatenate([mesh.facets[name].ravel() for name in fixed]))
        _check_bonded(mesh, held, fixed)
        on_surface = np.setdiff1d(np.unique(mesh.facets[SKIN]), held)
        if not len(on_surface):
            raise InputError(f"All nodes of '{SKIN}' are fixed ({few(fixed)}), so the plate cannot deform it.")
        Contact(self.plate, mesh.points_mm @ self.plate.axes, on_surface)
        _ = self.notes

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on an open mesh and on loads that are unusual for tissue.

        InputError for loads that no tissue can bear.
        """
        of_loads = (_unusual(self.mesh, self.materials, self.plate, load) for load in self.loads)
        return tuple(note for note in (where_open(self.mesh), *of_loads) if note)


@checked
def problems_of(
    mesh: TetMesh, materials: Materials, plate: Plate | Mapping[str, Plate], loads: Sequence[LoadStep],
    fixed: Sequence[str] = (BONE,), element: str = "P1",
) -> list[Problem]:  # fmt: skip
    """One problem for each load path (`fe.paths_of`); ``plate`` is one for all loads, or a mapping from load names.

    A path whose plate stays parallel passes the smaller loads without shear of the same plate. Solve paths with fewer
    of them first, and give their states to the others.

    Raises
    ------
    InputError
        As `Problem`, or if a load has no plate.
    """
    if isinstance(plate, Mapping) and (bare := [load.name for load in loads if load.name not in plate]):
        raise InputError(f"The mapping 'plate' has no plate for {few(bare)}; it has one for {few(plate) or 'no load'}.")
    plate_of = {load.name: plate if isinstance(plate, Plate) else plate[load.name] for load in loads}
    paths = paths_of(loads, {name: tuple(one.axes.round(9).ravel()) for name, one in plate_of.items()})
    return [
        Problem(mesh, materials, plate_of[path[0].name], path, fixed, element, _passed(path[0], loads, plate_of))
        for path in paths
    ]


def _passed(first: LoadStep, loads: Sequence[LoadStep], plate_of: Mapping[str, Plate]) -> tuple[LoadStep, ...]:
    """Loads without shear that a load passes, in ascending order: smaller, of an equal plate that stays parallel."""

    def pressed(load: LoadStep) -> tuple[Hashable, ...]:
        plate = plate_of[load.name]
        pivot = None if plate.pivot_mm is None else tuple(np.asarray(plate.pivot_mm, dtype=np.float64))
        return bool(load.target.displaced[0]), tuple(plate.axes.ravel()), plate.gap_mm, plate.taped, plate.turns, pivot

    if plate_of[first.name].turns:
        return ()
    like = [load for load in loads if not load.sheared and pressed(load) == pressed(first)]
    smaller: dict[float, LoadStep] = {}
    for load in like:
        if load.target.values[0] < first.target.values[0]:
            smaller.setdefault(float(load.target.values[0]), load)
    return tuple(smaller[value] for value in sorted(smaller))


def _check_passed(plate: Plate, loads: Sequence[LoadStep], passed: Sequence[LoadStep]) -> None:
    """InputError for loads that the first load of a path cannot pass on its way."""
    if not passed:
        return
    first = loads[0]
    if twice := clash(load.name for load in (*passed, *loads)):  # states are kept by name
        raise InputError(f"Two loads are named {twice}; rename one of them.")
    if plate.turns:
        raise InputError(
            f"{first.name} cannot include other loads as intermediate states: its plate rotates, and is released anew "
            "under each load."
        )
    check_loads(plate, passed)
    way = [*passed, first]
    for load, following in pairwise(way):
        if load.sheared or load.target.displaced[0] != first.target.displaced[0]:
            raise InputError(
                f"{first.name} cannot include {load.name} as an intermediate state: {load.name} has shear, or one of "
                "the two prescribes a force and the other a displacement."
            )
        if not load.target.values[0] < following.target.values[0]:
            raise InputError(
                f"Intermediate loads must be in ascending order and smaller than {first.name}: {load.name} is not "
                f"smaller than {following.name}."
            )


def check_loads(plate: Plate, loads: Sequence[LoadStep]) -> None:
    """InputError for loads that a plate cannot apply to tissue."""
    if not loads:
        raise InputError("At least one load is needed.")
    for load in loads:
        value, displaced = load.target.values[0], load.target.displaced[0]
        least, kind = (plate.gap_mm, "displacement") if displaced else (0.0, "force")
        if not (np.isfinite(load.target.values).all() and value > least):
            above = f"{least:g} mm (the gap)" if displaced else "0 N"
            raise InputError(
                f"{load.name}: the normal {kind} must be above {above}, so that the plate presses; got {load}. "
                "Positive values press, against the plate's outward normal."
            )
        if load.sheared and not plate.taped:
            raise InputError(
                f"{load.name}: a plate without friction cannot apply shear; got {load}. Let the skin stick."
            )


def _unusual(mesh: TetMesh, materials: Materials, plate: Plate, load: LoadStep) -> str:
    """A sentence on a load of over 1 MPa on all of the skin, of hardly any, or that moves the plate past the bone.

    Nothing for any other load.

    InputError if the pressure is over 1000 times the shear modulus of the stiffest tissue, or the plate would move by
    more than the size of the body. The true pressure is higher, because the plate touches only a part of the skin.
    """
    points = mesh.points_mm @ plate.axes
    faces, size_mm = points[mesh.facets[SKIN]], float(np.ptp(points, axis=0).max())
    area_mm2 = 0.5 * float(np.abs(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])[:, 0]).sum())
    stiffest_mpa = max(material.shear_modulus_mpa for material in materials.values())
    force_n = max(abs(load.normal_n or 0.0), abs(load.shear_n or 0.0))
    pressure_mpa = force_n / max(area_mm2, 1e-9)
    told = (
        f"The force of {load.name}, {force_n:g} N, is a pressure of {pressure_mpa:.3g} MPa on all of the skin "
        f"({area_mm2 / _MM2_PER_CM2:.3g} cm2)"
    )
    if pressure_mpa > _MOST_STIFFNESSES * stiffest_mpa:
        raise InputError(
            f"{told}, over {_MOST_STIFFNESSES:g} times the shear modulus of the stiffest tissue ({stiffest_mpa:.3g} "
            "MPa): no tissue withstands it. Forces are in N and moduli in MPa; check both."
        )
    inward_mm, along_mm = (load.normal_mm or 0.0) - plate.gap_mm, abs(load.shear_mm or 0.0)
    if max(inward_mm, along_mm) > size_mm:
        raise InputError(
            f"{load.name}: the plate would move by more than the size of the body ({size_mm:.3g} mm); got {load}. "
            "Displacements are in mm."
        )
    if pressure_mpa > _UNUSUAL_MPA:
        in_mn = " Is it in mN?" if pressure_mpa <= _UNITS * _UNUSUAL_MPA else ""
        return f"{told}; under a runner's heel it is about {_UNUSUAL_MPA:g} MPa. Forces are in N.{in_mn}"
    if load.normal_n is not None and pressure_mpa < _SLIGHT_MPA:
        in_kn = " Is it in kN?" if _UNITS * pressure_mpa <= _UNUSUAL_MPA else ""
        return f"{told}, less than the weight of 5 mm of tissue. Forces are in N.{in_kn}"
    if load.normal_mm is not None and inward_mm < _SLIGHT * size_mm:
        in_m = " Is it in m?" if _UNITS * load.normal_mm <= size_mm else ""
        return (
            f"Under {load.name} the plate would move by {inward_mm:.3g} mm into the tissue, less than a thousandth of "
            f"its size ({size_mm:.3g} mm). Displacements are in mm.{in_m}"
        )
    bone = np.setdiff1d(mesh.facets.get(BONE, np.empty(0, dtype=np.int64)), mesh.facets[SKIN])
    bone_mm = float(points[bone, 0].min(initial=np.inf) - faces[..., 0].min())
    if inward_mm > bone_mm:
        return (
            f"Under {load.name} the plate would move by {inward_mm:.3g} mm into the tissue, past the bone, which lies "
            f"{bone_mm:.3g} mm from the skin that it touches first."
        )
    return ""


@checked
def check_materials(mesh: TetMesh, materials: Materials) -> None:
    """InputError unless a mesh has every cell only once, and every cell has exactly one material that is no liquid."""
    for region, material in materials.items():
        if material.shear_modulus_mpa < _LIQUID_MPA:
            raise InputError(
                f"The material of {region} has a shear modulus of {1e6 * material.shear_modulus_mpa:.3g} Pa, like a "
                "liquid: no equilibrium would be found. Moduli are in MPa, or in kPa where the name says so; check "
                "them."
            )
    if len(again := repeated_rows(np.sort(mesh.cells, axis=1))):
        first = ", ".join(map(str, again[:_NAMED])) + (" ..." if len(again) > _NAMED else "")
        raise InputError(
            f"{len(again)} of {len(mesh.cells)} cells are repeated: others have the same four nodes, so their "
            f"stiffness would count twice. They are cells {first} (from 0). Remove them in the program that made the "
            "mesh."
        )
    times = np.zeros(len(mesh.cells), dtype=int)
    for region in materials:
        if region not in mesh.regions:
            raise InputError(f"The mesh has no region '{region}'; it has {few(mesh.regions) or 'none'}.")
        times[mesh.regions[region]] += 1
    if (times != 1).any():
        bare, twice = int((times == 0).sum()), int((times > 1).sum())
        without = [name for name in mesh.regions if name not in materials]
        bare_regions = f"Give each region one: {few(without, most=4)} has none." if without else ""
        raise InputError(
            f"Every cell needs exactly one material: {bare} cells have none and {twice} have more than one. "
            f"{bare_regions or 'Each cell must be in exactly one region.'}"
        )


def _check_bonded(mesh: TetMesh, held: IntArray, fixed: Sequence[str]) -> None:
    """InputError for cells that are not connected to a fixed node."""
    ends = np.repeat(mesh.cells[:, 0], 3), mesh.cells[:, 1:].ravel()
    count = len(mesh.points_mm)
    joined = sparse.csr_matrix((np.ones(len(ends[0]), dtype=np.int8), ends), shape=(count, count))
    _, part = connected_components(joined, directed=False)
    loose = ~np.isin(part[mesh.cells[:, 0]], part[held])
    if loose.any():
        raise InputError(
            f"{int(loose.sum())} of {len(loose)} cells are not connected to a fixed surface ({few(fixed, most=4)}). "
            "Tissues are bonded only where they share nodes; merge coincident nodes in the meshing program."
        )
