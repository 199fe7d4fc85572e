"""Finite-element models of soft tissue under load.

From a label map to a conforming tetrahedral mesh, constitutive models with published parameter sets, the fitting of a
model to a stretch-stress curve, a solver for nearly incompressible tissue under a rigid plate, and decks for other
solvers. Imports from `dvc` only.

    import fe

    mesh, quality = fe.mesh_labels(labels, edge_mm=2.0)
    plate = fe.Plate(normal=(0.0, 0.0, -1.0), shear=(0.0, -1.0, 0.0))
    simulation = fe.simulate(mesh, fe.material_set("trebbi"), plate, [fe.LoadStep("Load1", normal_n=140.0)])
    print(simulation)

Geometry is LPS mm in the undeformed configuration, force N, stress MPa. A name loads its file when it is first asked
for, so that importing this is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvc import TetMesh
    from dvc.errors import InputError, MrstrainError, OutputError, WorkerError
    from fe.convergence import Limit, cell_size_mm, extrapolate
    from fe.decks import write_calculix, write_febio
    from fe.fitting import LAWS, Fit, fit
    from fe.load_path import PlateState
    from fe.load_step import LoadStep, paths_of
    from fe.loading import Checkpoint
    from fe.materials import MODES, Hencky, Material, NeoHooke, Ogden, Yeoh
    from fe.mesh_file import read_tet_mesh, write_tet_mesh
    from fe.meshing import MeshQuality, check_meshing, mesh_labels
    from fe.newton import Tolerance
    from fe.plate import Plate
    from fe.problem import Problem, check_loads, check_materials, problems_of
    from fe.published import MaterialSet, as_toml, material_set, published_names, read_material_sets
    from fe.result import (
        RegionFigures,
        cauchy_stress,
        equivalent_stress,
        region_figures,
        write_regions_csv,
        write_state,
    )
    from fe.simulation import Simulation, simulate
    from fe.simulation_files import clear_simulation
    from fe.solution import LoadState, Observer, SolverOptions, solve
    from fe.stress_curves import Curve, read_curves
    from fe.surface_sets import BONE, CUT, SKIN, fixed_facets

__all__ = [
    "BONE", "CUT", "LAWS", "MODES", "SKIN", "Checkpoint", "Curve", "Fit", "Hencky", "InputError", "Limit",
    "LoadState", "LoadStep", "Material", "MaterialSet", "MeshQuality", "MrstrainError", "NeoHooke", "Observer",
    "Ogden", "OutputError", "Plate", "PlateState", "Problem", "RegionFigures", "Simulation", "SolverOptions",
    "TetMesh", "Tolerance", "WorkerError", "Yeoh", "as_toml", "cauchy_stress", "cell_size_mm", "check_loads",
    "check_materials", "check_meshing", "clear_simulation", "equivalent_stress", "extrapolate", "fit",
    "fixed_facets", "material_set", "mesh_labels", "paths_of", "problems_of", "published_names", "read_curves",
    "read_material_sets", "read_tet_mesh", "region_figures", "simulate", "solve", "write_calculix", "write_febio",
    "write_regions_csv", "write_state", "write_tet_mesh",
]  # fmt: skip

_HOMES = {
    "dvc.errors": "InputError MrstrainError OutputError WorkerError",
    "dvc.mesh": "TetMesh",
    "fe.convergence": "Limit cell_size_mm extrapolate",
    "fe.decks": "write_calculix write_febio",
    "fe.fitting": "LAWS Fit fit",
    "fe.load_path": "PlateState",
    "fe.load_step": "LoadStep paths_of",
    "fe.loading": "Checkpoint",
    "fe.materials": "MODES Hencky Material NeoHooke Ogden Yeoh",
    "fe.mesh_file": "read_tet_mesh write_tet_mesh",
    "fe.meshing": "MeshQuality check_meshing mesh_labels",
    "fe.newton": "Tolerance",
    "fe.plate": "Plate",
    "fe.problem": "Problem check_loads check_materials problems_of",
    "fe.published": "MaterialSet as_toml material_set published_names read_material_sets",
    "fe.result": "RegionFigures cauchy_stress equivalent_stress region_figures write_regions_csv write_state",
    "fe.simulation": "Simulation simulate",
    "fe.simulation_files": "clear_simulation",
    "fe.solution": "LoadState Observer SolverOptions solve",
    "fe.stress_curves": "Curve read_curves",
    "fe.surface_sets": "BONE CUT SKIN fixed_facets",
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names.split():
            return getattr(import_module(home), name)
    raise AttributeError(f"fe has no attribute {name!r}")
