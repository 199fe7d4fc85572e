"""What the parts of a command are expected to take, from what is known before it begins; seconds on idle cores."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from dvc.arrays import BoolArray, IntArray
from mrstrain.records.time_left import STARTING, WRITING, Expected

if TYPE_CHECKING:  # for a worker of a study that does not register or simulate, nor imports what does
    from dvc import LabelMap
    from dvc.registration.engine import Cost
    from fe import MaterialSet

LABELS = "labels"
"""The case of the label map that `register` makes."""
REPORT = "report"
"""The case, or the last part of one, in which tables, figures and the report of a command are written."""
TISSUES = "tissues"
"""Part of a label map that is made."""
MESHING, SIMULATING = "meshing", "simulating"
"""Parts of a mesh and of a simulation."""

USUAL_VOXELS = 2e6
"""Voxels of an image of which nothing is known."""

# From 13 recorded demonstrations on two idle cores (2.3 million voxels; 35,000 or 80,000 cells, four loads), and from
# registrations of 0.3 to 17 million voxels (benchmarks/results/register_scaling.json). Of a registration beside its
# engine (`Cost`): whatever the size, and for each million voxels.
_ALIGN_S, _ALIGN_S_PER_MVOXEL = 2.0, 0.8
_READ_S_PER_MVOXEL = 0.03
_ENGINE_S = 2.5
_MAPS_S, _MAPS_S_PER_MVOXEL = 3.5, 0.7
_TWIN = 1.3  # additional time, relative: the synthetic warp is made and registered
_MAKING = 0.3  # of it to make the warp
_CELLS, _LOAD_S, _GROWTH = 80e3, 12.0, 1.5  # a load of the set trebbi
# Of trebbi's time. From mesh to mesh luboz took 2.0 to 3.9, spears 2.4 to 7.0; friedman was stopped after 50.
_SET_TIMES = {
    "spears": 3.2,
    "luboz": 2.5,
    "trebbi": 1.0,
    "zwam": 0.85,
    "erdemir": 0.85,
    "akrami": 0.55,
    "friedman": 50.0,
}
_SOFT_MPA, _SOFTER = 0.03, 0.4  # of other sets, by their softest tissue: for published ones .6 to 1.6 of the above
# Of P1's time: P2 20 times as long on 60,000 cells of the heel, MINI a third of P2's time on 56,000.
_ELEMENT_TIMES = {"P1": 1.0, "MINI": 7.0, "P2": 20.0}
_MESH_S, _MESH_S_PER_CELL = 4.0, 0.54e-3
_COMPARE_S, _MODEL_S = 1.0, 5.1  # each load: of it, and of each of its models
_START_S = 3.0  # of a load path, beside its loads
PASSED = 0.3
"""Time of a load that a load path passes, over one of its own."""
_FIGURES_S = 2.0  # of a material set
# Of a phantom, for each million voxels: an unloaded image, a loaded one, and its true displacement and strain.
_UNLOADED_S_PER_MVOXEL, _LOADED_S_PER_MVOXEL, _TRUTH_S_PER_MVOXEL = 2.9, 8.0, 4.4
_LABEL_S_PER_MVOXEL, _LABEL_WRITING_S_PER_MVOXEL = 5.0, 0.4
_CARRIED = 2.5  # of the time of a label map: one that is transferred from another subject
_REPORT_S, _ACCURACY_REPORT_S, _MESH_WRITING_S = 1.0, 2.0, 2.0
# A `Cost` has the time for a phantom at 0.8 mm, of which so much is for its voxels.
_OF_VOXELS_S, _PHANTOM_VOXEL_MM3 = 24.0, 0.512
_COMPARE_PARTS = {"reading": 0.2, "comparing": 0.47, "writing": 0.33}  # of its time
# Cells fill the volume (`_SHAPE`: their volume over their edge cubed) and line the surfaces of tissues: heels of 35,000
# and 79,500 cells (label maps of 1.2 and 0.8 mm, edges of 4 and 2.8 mm) should have 33,000 and 83,000.
_SHAPE, _CELLS_PER_FACE = 0.1, 0.85


@dataclass(frozen=True, slots=True)
class PathSize:
    """What is known of a load path before it is solved: its material set, and numbers of its loads."""

    material: "MaterialSet"
    loads: int
    passed: int  # loads of another path that it passes


def registrations(
    names: Iterable[str], cost: "Cost", voxels: float, *, twin: bool = False, label_first: bool = False
) -> dict[str, Expected]:
    """Registrations of loads with an engine of this cost, and the report; ``voxels`` of the unloaded image.

    With ``label_first`` the label map is made before.
    """
    parts, first = registration_s(cost, voxels, twin=twin), {LABELS: Expected(label_s(voxels))} if label_first else {}
    loads = {name: Expected.of(parts, kind="register", before=tuple(first)) for name in names}
    return first | loads | {REPORT: Expected(_REPORT_S, before=tuple(loads))}


def labelling(voxels: float, *, carried: bool = False) -> Expected:
    """A label map of an image of so many voxels; ``carried`` from another subject, or not."""
    making = label_s(voxels) * (_CARRIED if carried else 1.0)
    return Expected.of({TISSUES: making, WRITING: _LABEL_WRITING_S_PER_MVOXEL * voxels / 1e6})


def usual_registration(cost: "Cost", *, twin: bool = False) -> Expected:
    """A registration of images of usual size; its parts have nearly the same shares at other sizes."""
    return Expected.of(registration_s(cost, USUAL_VOXELS, twin=twin))


def simulations(
    paths: Mapping[str, PathSize], cells: float, element: str, limit_s: float | None = None
) -> dict[str, Expected]:
    """Load paths on a mesh of so many cells, by name, each for at most ``limit_s``."""
    expected: dict[str, Expected] = {}
    for name, path in paths.items():
        solving = (path.loads + PASSED * path.passed) * load_s(cells, element, path.material)
        parts = {STARTING: _START_S, SIMULATING: solving if limit_s is None else min(solving, limit_s)}
        expected[name] = Expected.of(parts, kind=path.material.name)
    sets = dict.fromkeys(path.material.name for path in paths.values())
    of_set = {one: tuple(name for name, path in paths.items() if path.material.name == one) for one in sets}
    return expected | {figures_of(one): Expected(_FIGURES_S, before=of_set[one]) for one in sets}


def figures_of(material: str) -> str:
    """The case in which tables and figures of a material set are written."""
    return f"{material}, figures"


def comparison(models: Sequence[int], at_once: int) -> Expected:
    """A comparison of so many ``models`` of each load, so many loads at once."""
    return Expected.of({name: part_s / at_once for name, part_s in comparison_s(models).items()})


def phantom_images(unloaded: Iterable[str], loads: Iterable[str], voxels: float) -> Expected:
    """A phantom: unloaded images of so many voxels, and loaded ones with their truth; parts by the images' names."""
    parts = dict.fromkeys(unloaded, _UNLOADED_S_PER_MVOXEL * voxels / 1e6)
    loaded = {name: _LOADED_S_PER_MVOXEL + _TRUTH_S_PER_MVOXEL for name in loads}
    return Expected.of(parts | {name: each * voxels / 1e6 for name, each in loaded.items()})


def driven(sets: Iterable["MaterialSet"], loads: Iterable[str], cells: float) -> Expected:
    """Simulations with measured boundary conditions on a mesh of so many cells; parts as `driven_part`."""
    return Expected.of({driven_part(one.name, load): load_s(cells, material=one) for one, load in product(sets, loads)})


def driven_part(material: str, load: str) -> str:
    """The part of one material set and load."""
    return f"{material}, {load}"


def phantom_s(cost: "Cost", voxel_mm3: float) -> float:
    """Time to make, register and score a phantom with voxels of this volume."""
    return float(cost.phantom_seconds - _OF_VOXELS_S * (1.0 - _PHANTOM_VOXEL_MM3 / voxel_mm3))


def accuracy_runs(what: str, runs_s: float) -> Expected:
    """Phantoms that take so long together, and the report."""
    return Expected.of({what: runs_s, REPORT: _ACCURACY_REPORT_S})


def meshing(cells: float) -> Expected:
    """A mesh of so many cells."""
    return Expected.of({MESHING: mesh_s(cells) - _MESH_WRITING_S, WRITING: _MESH_WRITING_S}, guessed=(MESHING,))


def registration_s(cost: "Cost", voxels: float, *, twin: bool = False) -> dict[str, float]:
    """Time of each part of the registration of a load with an engine of this cost, by the part's name.

    ``voxels`` of the unloaded image; with ``twin``, the synthetic warp of the load is registered, too.
    """
    mvoxels = voxels / 1e6
    aligning = _ALIGN_S + _ALIGN_S_PER_MVOXEL * mvoxels
    registering = _ENGINE_S + cost.seconds + cost.seconds_per_mvoxel * mvoxels
    maps = _MAPS_S + _MAPS_S_PER_MVOXEL * mvoxels
    parts = {"aligning": aligning, "registering": registering}
    if twin:
        more_s = _TWIN * (aligning + registering + maps)
        of_both = (1.0 - _MAKING) * more_s / (aligning + registering)
        parts["making the synthetic warp"] = _MAKING * more_s
        parts |= {f"synthetic warp: {name}": of_both * parts[name] for name in ("aligning", "registering")}
    return parts | {"strain and figures": maps}


def reading_s(voxels: float) -> float:
    """Time to read a compressed image of so many voxels."""
    return _READ_S_PER_MVOXEL * voxels / 1e6


def label_s(voxels: float) -> float:
    """Time of a label map made from an image of so many voxels."""
    return _LABEL_S_PER_MVOXEL * voxels / 1e6


def mesh_s(cells: float) -> float:
    """Time of a mesh of so many cells."""
    return _MESH_S + _MESH_S_PER_CELL * cells


def load_s(cells: float, element: str = "P1", material: "MaterialSet | None" = None) -> float:
    """Time of a load with a material set on a mesh of so many cells; without a set, that of trebbi."""
    times = _ELEMENT_TIMES[element] * (1.0 if material is None else _set_time(material))
    return float(_LOAD_S * (cells / _CELLS) ** _GROWTH) * times


def _set_time(one: "MaterialSet") -> float:
    """Time of a solution over that of the material set trebbi."""
    softest_mpa = min(material.shear_modulus_mpa for material in one.materials.values())
    return _SET_TIMES.get(one.name, float((_SOFT_MPA / softest_mpa) ** _SOFTER))


def comparison_s(models: Sequence[int]) -> dict[str, float]:
    """Time of each part of a comparison, by the part's name; so many ``models`` of each load."""
    whole_s = sum(_COMPARE_S + _MODEL_S * count for count in models)
    return {name: share * whole_s for name, share in _COMPARE_PARTS.items()}


def cells_of(labels: "LabelMap", bones: Sequence[str], edge_mm: float) -> float:
    """Approximate number of cells of a mesh of all labels but the ``bones``."""
    soft = np.isin(labels.labels, [n for n, name in labels.names.items() if name not in bones and n != 0])
    volume = float(np.count_nonzero(soft)) * labels.grid.voxel_volume_mm3
    return volume / (_SHAPE * edge_mm**3) + _CELLS_PER_FACE * _faces(labels.labels, soft)


def _faces(labels: IntArray, soft: BoolArray) -> int:
    """Number of the faces of voxels between two labels of which one at least is a soft tissue."""
    count = 0
    for axis in range(3):
        across, inside = np.moveaxis(labels, axis, 0), np.moveaxis(soft, axis, 0)
        count += int(np.count_nonzero((across[1:] != across[:-1]) & (inside[1:] | inside[:-1])))
    return count
