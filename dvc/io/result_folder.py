"""The results folder of one loaded image: the names of its files (given here only), their writers and readers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.deformation.protocol import Deformation, RigidMotion, Within
from dvc.deformation.strain import StrainField
from dvc.deformation.strain_maps import TENSOR_COMPONENTS, StrainMaps
from dvc.errors import ImageFileError, InputError, few
from dvc.images.image import Grid, Image, Mask
from dvc.io.images.labels import read_mask
from dvc.io.images.nifti import read_nifti_header
from dvc.io.images.read import read_voxels
from dvc.io.images.write import write_image, write_mask, write_vectors
from dvc.io.meshes.read import MeshFile
from dvc.io.meshes.write import write_nodal_displacements, write_on_mesh
from dvc.io.transforms.interface_spline import FILE as INTERFACE_SPLINE
from dvc.io.transforms.read import read_displacement, read_transform
from dvc.io.transforms.write import ELASTIX_FILES
from dvc.own_files import read_json, read_rows
from dvc.trust.error_model import ErrorTable, read_error_model
from dvc.trust.verdict import Verdict

DISPLACEMENT, DISPLACEMENT_NRRD = "displacement.nii.gz", "displacement.nrrd"
GREEN_LAGRANGE, GREEN_LAGRANGE_PLATE = "green_lagrange.nii.gz", "green_lagrange_plate.nii.gz"
MAX_SHEAR, JACOBIAN, VALID = "max_shear.nii.gz", "jacobian.nii.gz", "valid.nii.gz"
ALIGNED, REGISTERED = "aligned.nii.gz", "registered.nii.gz"
SPLINE, SPLINE_WITH_BORDERS = ELASTIX_FILES[0], INTERFACE_SPLINE
ITK_TRANSFORM = "transform.h5"
BONE_USED = "bone_used.nii.gz"
SIGMA, BIAS = "sigma_max_shear.nii.gz", "bias_max_shear.nii.gz"
INTERVALS, ERROR_MODEL = "intervals.csv", "error_model.json"
SIGMA_NORMAL, SIGMA_SHEAR = "sigma_normal_strain.nii.gz", "sigma_shear_strain.nii.gz"
SIGMA_DISPLACEMENT, STRAIN_BIAS = "sigma_displacement.nii.gz", "strain_bias.nii.gz"
COMPONENTS = "components.csv"
SOFT_TISSUES, TO_BONE = "soft_tissues.nii.gz", "distance_to_bone.nii.gz"
REGIONS, QUALITY, PROVENANCE = "regions.csv", "quality.json", "provenance.json"
ON_MESH, AT_NODES = "mesh.vtu", "nodal_displacements.csv"
FIGURES, REPORT = "figures", "report.html"
REPEAT = "repeat"
"""Name of the folder of a repeat scan's results."""

AGAIN = "Register this load again, or copy the whole folder again."
_DISPLACEMENT = "displacement of tissue relative to its bone: u(X) = x - X at the voxels of the unloaded image"
_GREEN_LAGRANGE = "Green-Lagrange strain E = (F^T F - I) / 2"
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, slots=True, eq=False)
class ResultFolder:
    """The folder of one load as `register` or `strain` wrote it; its arrays are read on demand."""

    folder: Path
    table: ErrorTable | None = None
    verdict: Verdict | None = None
    aligned_on: str = ""

    @classmethod
    def at(cls, folder: Path) -> Self:
        """Open a folder; refused if its quality or its error model cannot be read."""
        model, verdict, aligned_on = folder / ERROR_MODEL, None, ""
        if (folder / QUALITY).is_file():
            told = read_quality(folder)
            try:
                verdict = Verdict(told["verdict"]["level"], tuple(told["verdict"]["reasons"]))
                aligned_on = str(told.get("alignment", {}).get("on", ""))
            except (KeyError, TypeError, AttributeError, InputError) as failure:
                what = f"the verdict or the alignment is missing or damaged ({failure!r})"
                raise InputError(f"{folder / QUALITY}: {what}. {AGAIN}") from failure
        return cls(folder, read_error_model(model).tables[0] if model.is_file() else None, verdict, aligned_on)

    @property
    def without_intervals(self) -> tuple[str, ...]:
        """Tissues whose intervals are left out, as too few true values would lie in them; see `dvc.trust.gaps`."""
        try:
            rows = read_rows(self.folder / INTERVALS) if (self.folder / INTERVALS).is_file() else []
            return tuple(dict.fromkeys(row["region"] for row in rows if np.isnan(float(row["low"]))))
        except (OSError, ValueError, KeyError) as failure:
            raise InputError(f"{self.folder / INTERVALS}: not a table of intervals ({failure!r}). {AGAIN}") from failure

    @property
    def load(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    @property
    def field(self) -> Path:
        """The displacement image."""
        return self.folder / DISPLACEMENT

    @property
    def files(self) -> list[Path]:
        """The files that the displacement is read from."""
        borders = self.folder / SPLINE_WITH_BORDERS
        return [borders, self.folder / VALID] if borders.is_file() else [self.field]

    def deformation(self) -> Deformation:
        """Displacement of tissue relative to its bone, with its strain discontinuities at tissue interfaces."""
        if (self.folder / SPLINE_WITH_BORDERS).is_file():
            return Within(spline_in(self.folder), read_mask(self.folder / VALID), margin_voxels=0)
        return read_displacement(self.field)


def result_folders(place: Path, loads: Sequence[str] = ()) -> list[ResultFolder]:
    """The loads in a folder that `register` or `strain` wrote, or the one whose folder it is; all, or those named."""
    folders = _folders(place)
    if not folders:
        what = f"no results of `mrstrain register` or `strain` in this folder (LOAD/{DISPLACEMENT})"
        raise InputError(f"{place}: {what}. Pass the folder that they wrote.")
    names = [folder.resolve().name for folder in folders]
    absent = [load for load in loads if load not in names]
    if absent:
        raise InputError(f"{place} has no results of {few(absent)}.")
    return [ResultFolder.at(folder) for folder, name in zip(folders, names, strict=True) if not loads or name in loads]


def holds_results(place: Path) -> bool:
    """Whether this is a folder that `register` or `strain` wrote, of all loads or of one."""
    return bool(_folders(place))


def _folders(place: Path) -> list[Path]:
    folders = [place] if (place / DISPLACEMENT).is_file() else sorted(p.parent for p in place.glob(f"*/{DISPLACEMENT}"))
    return [f for f in folders if f == place or f.name != REPEAT]


def spline_in(folder: Path) -> Deformation:
    """Displacement of tissue relative to its bone for one load: with its own gradient, or else from its image."""
    for name in (SPLINE_WITH_BORDERS, SPLINE):
        if (folder / name).is_file():
            return read_transform(folder / name)
    if (folder / ITK_TRANSFORM).is_file() and (folder / DISPLACEMENT).is_file():
        return read_displacement(folder / DISPLACEMENT)
    raise InputError(f"{folder}: neither {SPLINE_WITH_BORDERS} nor {SPLINE} is there. Register this load again.")


def read_quality(folder: Path) -> dict[str, Any]:
    """The content of ``quality.json``."""
    path = folder / QUALITY
    if not folder.is_dir():
        raise InputError(
            f"{folder}: there is no such folder. Name the folder of one load's results, such as results/Load1."
        )
    try:
        return read_json(path)
    except (OSError, ValueError) as failure:
        raise InputError(f"{path}: the quality of the registration cannot be read ({failure}). {AGAIN}") from failure


def motion_in(alignment: dict[str, Any]) -> RigidMotion:
    """The bone's rigid motion in ``quality.json``."""
    return RigidMotion(np.array(alignment["rotation"]), np.array(alignment["translation_lps_mm"]))


def write_maps(
    folder: Path, maps: StrainMaps, plate_axes: FloatArray | None = None, verdict: Verdict | None = None
) -> None:
    """Write displacement and strain maps as NIfTI on the reference grid, with their meaning in JSON beside.

    With `plate_axes` (3, 3), columns n, s, t (`dvc.plate_axes`), the strain in these axes is written too.
    """
    write_displacement(folder, maps.grid, maps.displacement_mm, verdict)
    write = partial(write_vectors, unit="1", verdict=verdict)
    write(folder / GREEN_LAGRANGE, maps.grid, maps.green_lagrange, TENSOR_COMPONENTS, _GREEN_LAGRANGE)
    if plate_axes is not None:
        in_plate, components = in_axes(maps.green_lagrange, plate_axes), ("nn", "ns", "nt", "ss", "st", "tt")
        meaning = (
            f"{_GREEN_LAGRANGE} in the plate's axes: n outward normal, s shear direction, t = n x s; "
            f"columns of {np.round(plate_axes, 6).tolist()} in LPS"
        )
        write(folder / GREEN_LAGRANGE_PLATE, maps.grid, in_plate, components, meaning, "invariant")
    write_image(folder / MAX_SHEAR, Image(maps.grid, maps.max_shear))
    write_image(folder / JACOBIAN, Image(maps.grid, maps.jacobian))
    write_mask(folder / VALID, Mask(maps.grid, maps.valid))


def read_maps(folder: Path) -> StrainMaps:
    """Read what `write_maps` wrote; a file that is missing, damaged or on another grid is refused."""
    shear = read_scalar(folder / MAX_SHEAR)
    grid = shear.grid
    jacobian, valid = read_scalar(folder / JACOBIAN, grid), read_mask(there(folder / VALID))
    displacement = _components(folder / DISPLACEMENT, grid, 3)
    tensor = _components(folder / GREEN_LAGRANGE, grid, len(TENSOR_COMPONENTS))
    same_grid(folder / VALID, valid.grid, grid)
    return StrainMaps(grid, valid.inside, displacement, tensor, shear.values, jacobian.values)


def read_scalar(path: Path, grid: Grid | None = None) -> Image:
    """Read a map or an image of the folder, on the grid of the others; NaN where not defined."""
    found, voxels = read_voxels(there(path))
    same_grid(path, found, found if grid is None else grid)
    return Image(found, np.ascontiguousarray(voxels, dtype=np.float32))


def _components(path: Path, grid: Grid, count: int) -> Float32Array:
    stored = read_nifti_header(there(path), vectors=True, components=count)
    same_grid(path, stored.grid, grid)
    return np.ascontiguousarray(stored.load(), dtype=np.float32)


def there(path: Path) -> Path:
    """A file of the folder; InputError where it is missing."""
    if not path.is_file():
        raise InputError(f"{path}: this file is missing from the results of a load. {AGAIN}")
    return path


def same_grid(path: Path, found: Grid, wanted: Grid) -> None:
    """Refuse a file on another grid than the other maps of its folder."""
    if not found.same_as(wanted):
        raise ImageFileError(f"{path}: on another grid than {MAX_SHEAR} in the same folder. {AGAIN}")


def write_displacement(folder: Path, grid: Grid, displacement_mm: Float32Array, verdict: Verdict | None = None) -> None:
    """Write the displacement as NIfTI and as NRRD, LPS mm."""
    write = partial(write_vectors, unit="mm", verdict=verdict)
    for name in (DISPLACEMENT_NRRD, DISPLACEMENT):  # the JSON beside them names the last
        write(folder / name, grid, displacement_mm, ("x", "y", "z"), _DISPLACEMENT)


def in_axes(tensor: Float32Array, axes: FloatArray) -> Float32Array:
    """Symmetric tensors (..., 6; 11, 12, 13, 22, 23, 33) in other axes: E' = A^T E A, columns of A the new axes."""
    full = np.empty((*tensor.shape[:-1], 3, 3), dtype=np.float32)
    for c, (i, j) in enumerate(_UPPER):
        full[..., i, j] = full[..., j, i] = tensor[..., c]
    turned = axes.T.astype(np.float32) @ full @ axes.astype(np.float32)
    return np.stack([turned[..., i, j] for i, j in _UPPER], axis=-1)


def write_mesh_results(
    folder: Path, mesh: MeshFile, deformation: Deformation, verdict: Verdict | None = None
) -> dict[str, int]:
    """Displacement and strain at the nodes and in the cells of a user's mesh; returns their numbers."""
    at_nodes, _ = _fields(deformation, mesh.points_mm)
    in_cells, without_value = _fields(deformation, mesh.centroids_mm)
    write_on_mesh(folder / ON_MESH, mesh, at_nodes, in_cells, verdict)
    missing = write_nodal_displacements(folder / AT_NODES, mesh, at_nodes["displacement_mm"], verdict)
    nodes = {"nodes": len(mesh.points_mm), "nodes_without_value": missing}
    return nodes | {"cells": mesh.cell_count, "cells_without_value": without_value}


def _fields(deformation: Deformation, points_mm: FloatArray) -> tuple[dict[str, FloatArray], int]:
    """Displacement and strain at points (n, 3) LPS mm, and at how many of them they are not defined."""
    u, H = deformation.evaluate(points_mm)
    strain = StrainField.from_gradient(H)
    named = {name: getattr(strain, name) for name in ("green_lagrange", "max_shear", "jacobian")}
    return {"displacement_mm": u, **named}, int(np.count_nonzero(~strain.valid))
