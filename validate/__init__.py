"""Finite-element models compared with measured deformation: how large the difference is, where, and whether it counts.

The public surface; a name is loaded when it is first used. All geometry is LPS mm in the reference (unloaded)
configuration unless a docstring says otherwise. Imports from `phantoms`, `fe` and `dvc`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dvc.errors import GeometryError, InputError, OutputError
    from validate.agreement import Agreement, SkinDisplacement, agreements, skin_displacement
    from validate.cohort import CohortRank, rank_over_subjects
    from validate.comparison import Comparison, compare
    from validate.curves import RANGE, Area, Band, area_between, bands, check_range
    from validate.extrapolation import LEVELLED, extrapolated
    from validate.fe_result import FeResult, check_overlap, read_result
    from validate.figures import over_subjects
    from validate.load_comparison import NOTHING, Criteria, LoadCase, LoadComparison, compare_load
    from validate.location import LEAST_ML, CellGraph, Overlap, StrainCluster, Threshold, overlap, read_thresholds
    from validate.mapping import ALL, Field, MappedFields, check_bones, filled_from_nearest, map_fields
    from validate.measured_boundary import boundary_displacement, simulate_driven, write_boundary_conditions
    from validate.misfit import check_in_tissue, check_models, displacement_slip, misfits
    from validate.ranking import ALL_LOADS, Ranking, rank_over_loads
    from validate.tables import Curve

__all__ = [
    "ALL",
    "ALL_LOADS",
    "LEAST_ML",
    "LEVELLED",
    "NOTHING",
    "RANGE",
    "Agreement",
    "Area",
    "Band",
    "CellGraph",
    "CohortRank",
    "Comparison",
    "Criteria",
    "Curve",
    "FeResult",
    "Field",
    "GeometryError",
    "InputError",
    "LoadCase",
    "LoadComparison",
    "MappedFields",
    "OutputError",
    "Overlap",
    "Ranking",
    "SkinDisplacement",
    "StrainCluster",
    "Threshold",
    "agreements",
    "area_between",
    "bands",
    "boundary_displacement",
    "check_bones",
    "check_in_tissue",
    "check_models",
    "check_overlap",
    "check_range",
    "compare",
    "compare_load",
    "displacement_slip",
    "extrapolated",
    "filled_from_nearest",
    "map_fields",
    "misfits",
    "over_subjects",
    "overlap",
    "rank_over_loads",
    "rank_over_subjects",
    "read_result",
    "read_thresholds",
    "simulate_driven",
    "skin_displacement",
    "write_boundary_conditions",
]  # fmt: skip
_FILES = {
    "dvc.errors": "GeometryError InputError OutputError",
    "validate.agreement": "Agreement SkinDisplacement agreements skin_displacement",
    "validate.cohort": "CohortRank rank_over_subjects",
    "validate.comparison": "Comparison compare",
    "validate.curves": "RANGE Area Band area_between bands check_range",
    "validate.extrapolation": "LEVELLED extrapolated",
    "validate.fe_result": "FeResult check_overlap read_result",
    "validate.figures": "over_subjects",
    "validate.load_comparison": "NOTHING Criteria LoadCase LoadComparison compare_load",
    "validate.location": "LEAST_ML CellGraph Overlap StrainCluster Threshold overlap read_thresholds",
    "validate.mapping": "ALL Field MappedFields check_bones filled_from_nearest map_fields",
    "validate.measured_boundary": "boundary_displacement simulate_driven write_boundary_conditions",
    "validate.misfit": "check_in_tissue check_models displacement_slip misfits",
    "validate.ranking": "ALL_LOADS Ranking rank_over_loads",
    "validate.tables": "Curve",
}
_PLACES = {name: file for file, names in _FILES.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(_PLACES[name]), name)
    raise AttributeError(f"validate has no attribute {name!r}")
