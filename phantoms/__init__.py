"""Synthetic image pairs with exactly known strain, and the error of a registration measured on them.

The public surface. A right heel defined in space (`Heel`), motions of its tissue with exact gradient and inverse, MR
images of both (`scan`, `heel_pair`), warps of a subject's own image (`synthetic_warp`), accuracy runs (`measure_run`),
their error tables, and the error model fitted to them (`fit_error_model`).

Points and displacements are LPS mm in the reference (unloaded) configuration unless a docstring says otherwise.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dvc.errors import GeometryError, InputError, MrstrainError
from phantoms.accuracy_run import RIGID, AccuracyCase, ErrorSamples, distances_mm, measure_run, motion_named
from phantoms.anatomy import FAT_SIGNAL, TISSUES, Heel
from phantoms.bodies import EllipsoidUnion
from phantoms.error_model import CoverageRow, coverage_rows, fit_error_model
from phantoms.error_tables import (
    SOFT,
    ErrorRow,
    FloorRow,
    ResolutionRow,
    RunRow,
    error_rows,
    floor_rows,
    resolution_rows,
    run_rows,
    wavelength_recovered,
)
from phantoms.flow import Border, Flow
from phantoms.heel import (
    LOADS,
    HeelPair,
    centred_grid,
    covering,
    default_foot_motion,
    heel_grid,
    heel_pair,
    labels_of,
    labels_to_mesh,
    misdrawn,
    pressed,
    random_foot_motion,
    scan,
    sliding,
    swelling,
    under_load,
    under_plate,
)
from phantoms.motions import Bending, ShearWave, compressed, sheared, stretched
from phantoms.mri import acquire, sensitivity
from phantoms.tissue_error import TissueError, errors_by_tissue
from phantoms.warp import Acquisition, SyntheticWarp, material_points, synthetic_warp

if TYPE_CHECKING:
    from phantoms import figures

__all__ = [
    "FAT_SIGNAL", "LOADS", "RIGID", "SOFT", "TISSUES", "AccuracyCase", "Acquisition", "Bending", "Border",
    "CoverageRow", "EllipsoidUnion", "ErrorRow", "ErrorSamples", "FloorRow", "Flow", "GeometryError", "Heel",
    "HeelPair", "InputError", "MrstrainError", "ResolutionRow", "RunRow", "ShearWave", "SyntheticWarp", "TissueError",
    "acquire", "centred_grid", "compressed", "coverage_rows", "covering", "default_foot_motion", "distances_mm",
    "error_rows", "errors_by_tissue", "figures", "fit_error_model", "floor_rows", "heel_grid", "heel_pair", "labels_of",
    "labels_to_mesh", "material_points", "measure_run", "misdrawn", "motion_named", "pressed", "random_foot_motion",
    "resolution_rows", "run_rows", "scan", "sensitivity", "sheared", "sliding", "stretched", "swelling",
    "synthetic_warp", "under_load", "under_plate", "wavelength_recovered",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "figures":  # draws, so that it takes a second to load
        return import_module("phantoms.figures")
    raise AttributeError(f"phantoms has no attribute {name!r}")
