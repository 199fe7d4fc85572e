"""Measured deformation: MR images, alignment on bone, B-spline registration, strain, and how far to trust it.

The public surface. All geometry is LPS mm in the reference (unloaded) configuration unless a docstring says otherwise.
What draws figures is loaded when it is first asked for: `measure` and the `Measurement` that it gives.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dvc import errors
from dvc.deformation.bordered_spline import BorderedSpline
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import (
    Affine,
    Composed,
    Deformation,
    RigidMotion,
    SampledDisplacement,
    Within,
    evaluate_on_grid,
)
from dvc.deformation.strain import StrainField, plate_axes, principal_values
from dvc.deformation.strain_maps import StrainMaps, strain_maps
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.images.similarity import local_correlation
from dvc.images.tissue import tissue_mask
from dvc.io.images.labels import fit_mask, read_labels, read_mask
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_labels, write_mask, write_vectors
from dvc.io.meshes.read import MeshFile, read_mesh
from dvc.io.transforms.displacement_image import read_displacement
from dvc.io.transforms.read import read_transform
from dvc.mesh import TetMesh
from dvc.registration.align import Alignment
from dvc.registration.elastix.engine import Elastix
from dvc.registration.elastix.presets import Preset, load_preset, preset_names, read_parameter_file
from dvc.registration.engine import AlignedPair, Engine
from dvc.registration.engines import engine_named
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonWithInterfaces
from dvc.registration.register import Registration, Settings, register
from dvc.trust.assessment import Similarity, assess
from dvc.trust.landmarks import read_landmarks, target_registration_error
from dvc.trust.quality import Quality, noise_floor
from dvc.trust.verdict import Verdict

if TYPE_CHECKING:
    from dvc.measurement.measure import measure
    from dvc.measurement.measurement import Measurement
    from dvc.measurement.source import Evidence
    from dvc.measurement.subject import Subject

__all__ = [
    "Affine",
    "AlignedPair",
    "Alignment",
    "BSpline",
    "BorderedSpline",
    "Composed",
    "Deformation",
    "Elastix",
    "Engine",
    "Evidence",
    "GaussNewton",
    "GaussNewtonWithInterfaces",
    "Grid",
    "Image",
    "LabelMap",
    "Mask",
    "Measurement",
    "MeshFile",
    "Preset",
    "Quality",
    "Registration",
    "RigidMotion",
    "SampledDisplacement",
    "Settings",
    "Similarity",
    "StrainField",
    "StrainMaps",
    "Subject",
    "TetMesh",
    "Verdict",
    "Within",
    "assess",
    "engine_named",
    "errors",
    "evaluate_on_grid",
    "fit_mask",
    "load_preset",
    "local_correlation",
    "measure",
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

_WITH_FIGURES = {
    "Evidence": "source",
    "Measurement": "measurement",
    "Subject": "subject",
    "measure": "measure",
}


def __getattr__(name: str) -> Any:
    if name in _WITH_FIGURES:
        return getattr(import_module(f"dvc.measurement.{_WITH_FIGURES[name]}"), name)
    raise AttributeError(f"dvc has no attribute {name!r}")
