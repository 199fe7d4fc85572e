from .agreement import Agreement, SkinDisplacement, agreements, skin_displacement
from .comparison import Comparison, compare
from .comparison_error import ComparisonError
from .curves import RANGE, Area, Band, area_between, bands, check_range
from .decomposition import (
    Decomposition,
    Reconstruction,
    Representation,
    TissueBasis,
    decompose,
    probability_of_representation,
    representation,
)
from .extrapolation import LEVELLED, extrapolated
from .fe_result import FeResult, check_overlap, read_result
from .figures import over_subjects
from .from_dvc import GeometryError, InputError, OutputError
from .load_comparison import NOTHING, Criteria, LoadCase, LoadComparison, compare_load
from .location import LEAST_ML, CellGraph, Overlap, StrainCluster, Threshold, overlap, read_thresholds
from .mapping import ALL, Field, MappedFields, check_bones, filled_from_nearest, map_fields
from .mavm import ModelForm, model_form, safety_factor, signed_areas
from .measured_boundary import boundary_displacement, simulate_driven, write_boundary_conditions
from .misfit import Misfit, check_in_tissue, check_models, displacement_slip, misfits
from .ranking import ALL_LOADS, CohortRank, Ranking, rank_over_loads, rank_over_subjects
from .sensitivity import SHARED, Variant
from .tables import Curve

__all__ = [
    "ALL", "ALL_LOADS", "LEAST_ML", "LEVELLED", "NOTHING", "RANGE", "SHARED", "Agreement", "Area", "Band",
    "CellGraph", "CohortRank", "Comparison", "ComparisonError", "Criteria", "Curve", "Decomposition", "FeResult",
    "Field", "GeometryError", "InputError", "LoadCase", "LoadComparison", "MappedFields", "Misfit", "ModelForm",
    "OutputError", "Overlap", "Ranking", "Reconstruction", "Representation", "SkinDisplacement", "StrainCluster",
    "Threshold", "TissueBasis", "Variant", "agreements", "area_between", "bands", "boundary_displacement",
    "check_bones", "check_in_tissue", "check_models", "check_overlap", "check_range", "compare", "compare_load",
    "decompose", "displacement_slip", "extrapolated", "filled_from_nearest", "map_fields", "misfits", "model_form",
    "over_subjects", "overlap", "probability_of_representation", "rank_over_loads", "rank_over_subjects",
    "read_result", "read_thresholds", "representation", "safety_factor", "signed_areas", "simulate_driven",
    "skin_displacement", "write_boundary_conditions",
]  # fmt: skip
