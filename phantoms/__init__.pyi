from . import figures
from .accuracy_run import RIGID, AccuracyCase, ErrorSamples, distances_mm, measure_run, sampled_errors
from .anatomy import FAT_SIGNAL, TISSUES, Heel
from .bodies import EllipsoidUnion
from .error_model import CoverageRow, coverage_rows, fit_error_model, widened_for
from .error_tables import (
    SOFT,
    ErrorRow,
    FloorRow,
    ResolutionRow,
    RunRow,
    TissueError,
    error_rows,
    errors_by_tissue,
    errors_of_maps,
    floor_rows,
    resolution_rows,
    run_rows,
    wavelength_recovered,
)
from .flow import Border, Flow
from .from_dvc import GeometryError, InputError, MrstrainError
from .heel import (
    LOADS,
    HeelPair,
    attached,
    centred_grid,
    covering,
    default_foot_motion,
    heel_grid,
    heel_pair,
    labels_of,
    labels_to_mesh,
    misdrawn,
    motion_named,
    pressed,
    random_foot_motion,
    scan,
    sliding,
    swelling,
    under_load,
    under_plate,
)
from .motions import Bending, ShearStar, ShearWave, compressed, sheared, stretched
from .mri import acquire, sensitivity
from .star import Efficiency, StarPair, StarRow, efficiencies, resolved_mm, star_pair, star_rows, tissue_bar
from .warp import Acquisition, SyntheticWarp, material_points, synthetic_warp

__all__ = [
    "FAT_SIGNAL", "LOADS", "RIGID", "SOFT", "TISSUES", "AccuracyCase", "Acquisition", "Bending", "Border",
    "CoverageRow", "Efficiency", "EllipsoidUnion", "ErrorRow", "ErrorSamples", "FloorRow", "Flow",
    "GeometryError", "Heel", "HeelPair", "InputError", "MrstrainError", "ResolutionRow", "RunRow",
    "ShearStar", "ShearWave", "StarPair", "StarRow", "SyntheticWarp", "TissueError", "acquire",
    "attached", "centred_grid", "compressed", "coverage_rows", "covering", "default_foot_motion", "distances_mm",
    "efficiencies", "error_rows", "errors_by_tissue", "errors_of_maps", "figures", "fit_error_model",
    "floor_rows", "heel_grid", "heel_pair", "labels_of", "labels_to_mesh", "material_points", "measure_run",
    "misdrawn", "motion_named", "pressed", "random_foot_motion", "resolution_rows", "resolved_mm", "run_rows",
    "sampled_errors", "scan", "sensitivity", "sheared", "sliding", "star_pair", "star_rows", "stretched",
    "swelling", "synthetic_warp", "tissue_bar", "under_load", "under_plate", "wavelength_recovered", "widened_for",
]  # fmt: skip
