from .convergence import (
    ASSUMED_ORDER,
    LEAST_RATIO,
    SAFETY,
    SAFETY_WITHOUT_ORDER,
    Limit,
    cell_size_mm,
    extrapolate,
    mesh_steps,
)
from .decks import write_calculix, write_febio
from .fitting import LAWS, Curve, Fit, fit, read_curves
from .from_dvc import InputError, MrstrainError, OutputError, TetMesh, WorkerError
from .load_path import PlateState
from .loading import Checkpoint
from .materials import MODES, Hencky, Material, NeoHooke, Ogden, Yeoh
from .mesh_file import BONE, CUT, SKIN, fixed_facets, read_tet_mesh, write_tet_mesh
from .meshing import MeshQuality, check_meshing, mesh_labels
from .newton import Tolerance
from .plate import Plate
from .problem import LoadStep, Problem, check_loads, check_materials, paths_of, problems_of
from .published import MaterialSet, as_toml, material_set, published_names, read_material_sets
from .result import RegionFigures, cauchy_stress, equivalent_stress, region_figures, write_regions_csv, write_state
from .simulation import Simulation, simulate
from .simulation_files import begin_simulation
from .solution import LoadState, Observer, SolverOptions, solve

__all__ = [
    "ASSUMED_ORDER", "BONE", "CUT", "LAWS", "LEAST_RATIO", "MODES", "SAFETY", "SAFETY_WITHOUT_ORDER", "SKIN",
    "Checkpoint", "Curve", "Fit", "Hencky", "InputError", "Limit", "LoadState", "LoadStep", "Material", "MaterialSet",
    "MeshQuality", "MrstrainError", "NeoHooke", "Observer", "Ogden", "OutputError", "Plate", "PlateState", "Problem",
    "RegionFigures", "Simulation", "SolverOptions", "TetMesh", "Tolerance", "WorkerError", "Yeoh", "as_toml",
    "begin_simulation", "cauchy_stress", "cell_size_mm", "check_loads", "check_materials", "check_meshing",
    "equivalent_stress", "extrapolate", "fit", "fixed_facets", "material_set", "mesh_labels", "mesh_steps",
    "paths_of", "problems_of", "published_names", "read_curves", "read_material_sets", "read_tet_mesh",
    "region_figures", "simulate", "solve", "write_calculix", "write_febio", "write_regions_csv", "write_state",
    "write_tet_mesh",
]  # fmt: skip
