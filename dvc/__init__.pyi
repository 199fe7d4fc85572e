from . import errors
from .deformation.bspline import BSpline
from .deformation.interface_spline import InterfaceSpline
from .deformation.protocol import (
    Affine,
    Composed,
    Deformation,
    RigidMotion,
    SampledDisplacement,
    Within,
    evaluate_on_grid,
)
from .deformation.strain import StrainField, plate_axes, principal_values
from .deformation.strain_maps import StrainMaps, strain_maps
from .images.image import Grid, Image, LabelMap, Mask
from .images.similarity import local_correlation
from .images.tissue import tissue_mask
from .io.images.labels import fit_mask, read_labels, read_mask
from .io.images.read import read_image
from .io.images.write import write_image, write_labels, write_mask, write_vectors
from .io.meshes.read import MeshFile, read_mesh
from .io.transforms.read import read_displacement, read_transform
from .labelling.boundaries import correct_labels
from .labelling.carried import labels_from
from .labelling.tissues import TissueLabels, label_tissues
from .measurement.judgement import Evidence
from .measurement.measure import measure
from .measurement.measurement import Measurement
from .measurement.subject import Subject
from .mesh import TetMesh
from .registration.align import Alignment
from .registration.elastix.engine import Elastix
from .registration.elastix.presets import Preset, load_preset, preset_names, read_parameter_file
from .registration.engine import AlignedPair, Engine
from .registration.engines import engine_named
from .registration.gauss_newton.engine import GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces
from .registration.register import Registration, Settings, register
from .report.style import FIGURE_STYLE
from .trust.assessment import Similarity, assess
from .trust.error_model import ErrorModel, ErrorTable, read_error_model
from .trust.landmarks import read_landmarks, target_registration_error
from .trust.quality import Quality, noise_floor
from .trust.verdict import Verdict

__all__ = [
    "FIGURE_STYLE", "Affine", "AlignedPair", "Alignment", "BSpline", "Composed", "Deformation", "Elastix", "Engine",
    "ErrorModel", "ErrorTable", "Evidence", "GaussNewton", "GaussNewtonAtBone", "GaussNewtonWithInterfaces", "Grid",
    "Image", "InterfaceSpline", "LabelMap", "Mask", "Measurement", "MeshFile", "Preset", "Quality", "Registration",
    "RigidMotion", "SampledDisplacement", "Settings", "Similarity", "StrainField", "StrainMaps", "Subject", "TetMesh",
    "TissueLabels", "Verdict", "Within", "assess", "correct_labels", "engine_named", "errors", "evaluate_on_grid",
    "fit_mask", "label_tissues", "labels_from", "load_preset", "local_correlation", "measure", "noise_floor",
    "plate_axes", "preset_names", "principal_values",
    "read_displacement", "read_error_model", "read_image", "read_labels", "read_landmarks", "read_mask", "read_mesh",
    "read_parameter_file", "read_transform", "register", "strain_maps", "target_registration_error", "tissue_mask",
    "write_image", "write_labels", "write_mask", "write_vectors",
]  # fmt: skip
