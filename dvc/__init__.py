"""Measured deformation: MR images, alignment on bone, B-spline registration, strain, and how far to trust it.

The public surface. All geometry is LPS mm in the reference (unloaded) configuration unless a docstring says otherwise.
"""

from dvc.align import Alignment
from dvc.borders import BorderedSpline
from dvc.bspline import BSpline
from dvc.deformation import (
    Affine,
    Composed,
    Deformation,
    RigidMotion,
    SampledDisplacement,
    Within,
    evaluate_on_grid,
)
from dvc.displacementfile import read_displacement
from dvc.image import Grid, Image, LabelMap, Mask
from dvc.imagefile import read_image
from dvc.imagewrite import write_image, write_labels, write_mask, write_vectors
from dvc.kinematics import StrainField, plate_axes, principal_values
from dvc.labels import fit_mask, read_labels, read_mask
from dvc.landmarks import read_landmarks, target_registration_error
from dvc.mesh import TetMesh
from dvc.meshfile import MeshFile, read_mesh
from dvc.presets import Preset, load_preset, preset_names, read_parameter_file
from dvc.quality import Quality, assess, noise_floor
from dvc.registration import Registration, Settings, register
from dvc.sharpen import AtBorders
from dvc.similarity import local_correlation
from dvc.strainmaps import StrainMaps, strain_maps
from dvc.tissue import tissue_mask
from dvc.transformfile import read_transform
from dvc.verdict import Verdict

__all__ = [
    "Affine",
    "Alignment",
    "AtBorders",
    "BSpline",
    "BorderedSpline",
    "Composed",
    "Deformation",
    "Grid",
    "Image",
    "LabelMap",
    "Mask",
    "MeshFile",
    "Preset",
    "Quality",
    "Registration",
    "RigidMotion",
    "SampledDisplacement",
    "Settings",
    "StrainField",
    "StrainMaps",
    "TetMesh",
    "Verdict",
    "Within",
    "assess",
    "evaluate_on_grid",
    "fit_mask",
    "load_preset",
    "local_correlation",
    "noise_floor",
    "plate_axes",
    "preset_names",
    "principal_values",
    "read_displacement",
    "read_image",
    "read_labels",
    "read_landmarks",
    "read_mask",
    "read_mesh",
    "read_parameter_file",
    "read_transform",
    "register",
    "strain_maps",
    "target_registration_error",
    "tissue_mask",
    "write_image",
    "write_labels",
    "write_mask",
    "write_vectors",
]
