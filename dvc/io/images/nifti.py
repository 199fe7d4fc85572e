"""NIfTI files, read with the checks that the usual readers leave out.

A file may give its geometry twice (qform and sform), in one of several units, in the frame RAS. Programs differ in
which of the two they take; here both must agree. Everything is returned in LPS mm.
"""

import logging
from itertools import product
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
from nibabel.quaternions import quat2mat

from dvc.arrays import FloatArray
from dvc.errors import ImageFileError
from dvc.io.images.stored import MAX_BYTES, StoredVolume, expanded, grid_of_axes, pick_volume, refuse_if_too_large

_log = logging.getLogger("dvc.images")

LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Turns an affine to RAS into one to LPS, and back."""

_AGREEMENT_VOXELS = 0.05
_UNITS = {0: ("mm", 1.0), 1: ("metres", 1000.0), 2: ("mm", 1.0), 3: ("microns", 0.001)}
_HALF_TURN = 1e-7
_ROUNDING = 4e-7  # of b^2 + c^2 + d^2 in single precision, with a margin


def read_nifti_header(
    path: Path, volume: int | None = None, max_bytes: int = MAX_BYTES, vectors: bool = False, components: int = 3
) -> StoredVolume:
    """What a NIfTI-1 or -2 file holds: scalars, or with `vectors` c `components` per voxel, (ni, nj, nk, 1, c)."""
    header, compressed = _header(path)
    sizes = [int(n) for n in header["dim"][1 : 1 + int(header["dim"][0])]]
    if vectors and (sizes[3:5] != [1, components] or any(n not in (0, 1) for n in sizes[5:])):
        raise ImageFileError(
            f"{path}: the NIfTI has shape {tuple(sizes)}; a displacement image has (ni, nj, nk, 1, {components}). If "
            "this is an MR image, register it (mrstrain register); otherwise export the displacement again."
        )
    shape, count = _sizes(path, sizes[:3] if vectors else sizes)
    layout = (*shape, components) if vectors else shape
    # Size and count come first: a header that is wrong there is not worth a look at its geometry.
    refuse_if_too_large(path, layout, max_bytes)
    chosen = pick_volume(path, count, volume)
    dtype = _number_type(path, header)
    unit, mm_per_unit = _unit(path, header)
    lps = LPS_FROM_RAS @ _ras_affine(path, header, shape)
    columns = lps[:3, :3] * mm_per_unit
    grid = grid_of_axes(path, shape, columns, lps[:3, 3] * mm_per_unit, single_precision=True)
    bytes_each = int(np.prod(layout)) * dtype.itemsize
    start = max(int(header["vox_offset"]), int(header["sizeof_hdr"]) + 4) + chosen * bytes_each
    rest = (count - 1 - chosen) * bytes_each
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    if slope == 0.0 or not np.isfinite(slope):
        slope, intercept = 1.0, 0.0
    intercept, axis = intercept if np.isfinite(intercept) else 0.0, 3 if vectors else None
    return StoredVolume(path, grid, dtype, layout, unit, 0, compressed, start, rest, slope, intercept, components=axis)


def _header(path: Path) -> tuple[Any, bool]:
    """The file's header, and whether the file is compressed."""
    with path.open("rb") as file:
        start = file.read(544)
    compressed = start[:2] == b"\x1f\x8b"
    if compressed:
        start = b""
        for block in expanded(path):
            start += block
            if len(start) >= 544:
                break
    for kind, size, magic in ((nibabel.Nifti1Header, 348, slice(344, 348)), (nibabel.Nifti2Header, 540, slice(4, 8))):
        written = start[magic] if len(start) >= size else b""
        if written[:3] in (b"ni1", b"ni2"):
            raise ImageFileError(
                f"{path}: pairs of .hdr and .img files are not supported. Convert to one .nii.gz file."
            )
        if written[:3] in (b"n+1", b"n+2"):
            # The library's own check is left out: it repairs some faults and prints others.
            header = kind(start[:size], check=False)
            for field, low, high in (("dim", 1, 7), ("vox_offset", 0, 2**31)):
                value = float(np.ravel(header[field])[0])
                if not low <= value <= high:
                    raise ImageFileError(f"{path}: the NIfTI header is damaged ({field} = {value:g}). Export it again.")
            return header, compressed
    problem = f"no NIfTI header in its first {len(start)} bytes"
    raise ImageFileError(f"{path}: not a NIfTI file ({problem}). Check the file name, or export it again.")


def _sizes(path: Path, sizes: list[int]) -> tuple[tuple[int, int, int], int]:
    """Shape of an image, and its number of volumes."""
    while len(sizes) > 3 and sizes[-1] in (0, 1):
        sizes.pop()
        if len(sizes) == 3:
            _log.info("%s: a file of 4 or more dimensions with one volume; read as 3D", path)
    if min(sizes) < 1:
        raise ImageFileError(
            f"{path}: the header gives the image sizes {sizes}; all must be positive. Export it again."
        )
    if len(sizes) < 3:
        raise ImageFileError(
            f"{path}: the image is {len(sizes)}D, {sizes} voxels; a 3D image is needed. Give all slices in one file."
        )
    if len(sizes) > 4:
        raise ImageFileError(
            f"{path}: the file is {len(sizes)}D, {sizes} (vectors or tensors); a 3D scalar image is needed."
        )
    return (sizes[0], sizes[1], sizes[2]), sizes[3] if len(sizes) == 4 else 1


def _number_type(path: Path, header: Any) -> np.dtype[Any]:
    code = int(header["datatype"])
    try:
        dtype: np.dtype[Any] = np.dtype(header.get_data_dtype())
    except KeyError:
        raise ImageFileError(
            f"{path}: unknown NIfTI data type {code}; the header is damaged. Export it again."
        ) from None
    if dtype.kind not in "iuf" or dtype.itemsize > 8 or dtype.itemsize < 1:
        problem = f"colour and complex images are not supported (NIfTI data type {code})"
        raise ImageFileError(f"{path}: {problem}. Save the magnitude image.")
    return dtype


def _unit(path: Path, header: Any) -> tuple[str, float]:
    """The header's unit of length and its size in mm; mm where it gives none."""
    code = int(header["xyzt_units"]) & 7
    if code not in _UNITS:
        raise ImageFileError(f"{path}: unknown unit of length (xyzt_units code {code}); set it to mm (2).")
    if code == 0:
        _log.warning("%s: the header gives no unit of length; mm is assumed", path)
    return _UNITS[code]


def _ras_affine(path: Path, header: Any, shape: tuple[int, int, int]) -> FloatArray:
    qforms = _qforms(path, header) if int(header["qform_code"]) > 0 else []
    full = np.vstack([*(np.float64(header[f"srow_{axis}"]) for axis in "xyz"), [0.0, 0.0, 0.0, 1.0]])
    sforms = [full] if int(header["sform_code"]) > 0 else []
    if not qforms and not sforms:
        raise ImageFileError(
            f"{path}: the header has no orientation (qform_code and sform_code are 0), and programs would assume "
            "different ones. Export it again with its orientation, or copy the header of its source."
        )
    for name, affines in (("qform", qforms), ("sform", sforms)):
        if not np.isfinite(affines).all():
            raise ImageFileError(
                f"{path}: the {name} has values that are not finite (header damaged). Export it again."
            )
    if qforms and sforms:
        _refuse_disagreement(path, qforms, sforms[0], shape)
    return (sforms or qforms)[0]  # a full matrix holds its digits better than a quaternion


def _qforms(path: Path, header: Any) -> list[FloatArray]:
    """Affine of the quaternion [1]_, and others that single precision cannot distinguish from it.

    The header holds b, c, d; a is what is left of a unit quaternion. Near a half turn, which is where axial images lie,
    rounding of b, c, d leaves a uncertain by up to 5e-4: a voxel at the end of a large image.

    .. [1] Cox RW et al. A (sort of) new image data format standard: NIfTI-1. Human Brain Mapping 2004.
    https://nifti.nimh.nih.gov/nifti-1
    """
    b, c, d = (float(header[f"quatern_{name}"]) for name in "bcd")
    rest = 1.0 - (b * b + c * c + d * d)
    if not rest > -1e-4:
        raise ImageFileError(f"{path}: the qform's quaternion is not a rotation (header damaged). Export it again.")
    nominal = rest if rest >= _HALF_TURN else 0.0  # as the standard's own reader takes it
    least, most = np.sqrt(max(rest - _ROUNDING, 0.0)), np.sqrt(max(rest + _ROUNDING, 0.0))
    sizes = np.abs(np.float64(header["pixdim"][1:4]))
    sizes[2] *= -1.0 if float(header["pixdim"][0]) < 0 else 1.0  # qfac, of which 0 stands for +1
    offset = [float(header[f"qoffset_{axis}"]) for axis in "xyz"]
    turned = (quat2mat((a, b, c, d)) * sizes for a in (np.sqrt(nominal), *np.linspace(least, most, 65)))
    return [np.vstack([np.column_stack([columns, offset]), [0.0, 0.0, 0.0, 1.0]]) for columns in turned]


def _refuse_disagreement(path: Path, qforms: list[FloatArray], sform: FloatArray, shape: tuple[int, int, int]) -> None:
    corners = np.array([[*corner, 1.0] for corner in product(*((0.0, n - 1.0) for n in shape))])
    apart = min(float(np.linalg.norm((corners @ (sform - q).T)[:, :3], axis=1).max()) for q in qforms)
    voxel = float(np.linalg.norm(sform[:3, :3], axis=0).min())
    if not apart <= _AGREEMENT_VOXELS * voxel:
        raise ImageFileError(
            f"{path}: qform and sform differ: they place the image corners up to {apart:.3g} (header units) apart, "
            f"{apart / voxel if voxel > 0 else np.inf:.3g} voxels. Programs differ in which of the two they use. "
            "Set the code of the wrong one to 0, or export the image again with one orientation."
        )
