"""Reading images (NIfTI, NRRD, MetaImage, DICOM) to an Image in LPS mm; conversions are logged by ``dvc.images``."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dvc.arguments import checked
from dvc.errors import ImageFileError, InputError
from dvc.file_names import missing
from dvc.images.image import Grid, Image
from dvc.io import StrPath
from dvc.io.images.dicom import is_dicom, read_dicom
from dvc.io.images.nifti import read_nifti_header
from dvc.io.images.stored import MAX_BYTES, StoredVolume, Voxels
from dvc.io.images.text_headers import read_meta_header, read_nrrd_header

_log = logging.getLogger("dvc.images")

_SMALLEST_MM, _LARGEST_MM = 1.0, 3000.0  # along the longest edge of an image
_MOST_UNLIKE = 100.0  # longest over shortest edge of a voxel
_MIN_SLICES = 4

_FORMATS: dict[str, tuple[str, Callable[[Path, int | None, int, bool, int], StoredVolume]]] = {
    ".nii": ("NIfTI", read_nifti_header), ".nii.gz": ("NIfTI", read_nifti_header),
    ".nrrd": ("NRRD", read_nrrd_header), ".nhdr": ("NRRD", read_nrrd_header),
    ".mha": ("MetaImage", read_meta_header), ".mhd": ("MetaImage", read_meta_header),
}  # fmt: skip


def read_image(
    path: StrPath, *, allow_missing: bool = False, series: str | None = None, volume: int | None = None,
    max_bytes: int = MAX_BYTES,
) -> Image:  # fmt: skip
    """Read a 3D image of any supported format into LPS mm; voxel order as in the file, slope and intercept applied.

    Parameters
    ----------
    path : file (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd, enhanced DICOM) or folder of a DICOM series
    allow_missing : bool
        Treat NaN and infinite voxels as missing (NaN), instead of refusing the image.
    series : str, optional
        DICOM series, echo, stack or similar, if there are several; the error message lists their names.
    volume : int, optional
        Number of the volume in a 4D file, from 0.
    max_bytes : int
        Largest image that is read, counted in single precision.

    Raises
    ------
    ImageFileError
        If the file is damaged, of an unknown kind, not a scalar 3D image of four slices or more, constant, or its
        geometry is missing or contradictory.
    InputError
        If there is no such file, an argument is of another kind, voxels are NaN or infinite and ``allow_missing`` is
        not set, or ``series`` is missing or unknown.
    """
    grid, voxels = read_voxels(path, series=series, volume=volume, max_bytes=max_bytes)
    if min(grid.shape) < _MIN_SLICES:
        raise ImageFileError(
            f"{path}: the image has {' x '.join(map(str, grid.shape))} voxels. Strain in three dimensions needs at "
            f"least {_MIN_SLICES} slices along each axis. Give all of them in one file."
        )
    with np.errstate(over="ignore"):  # beyond single precision: infinite, and refused below
        values = np.ascontiguousarray(voxels, dtype=np.float32)
    finite = np.isfinite(values)
    missing = values.size - int(np.count_nonzero(finite))
    if missing == values.size:
        raise ImageFileError(f"{path}: no voxel has a finite value. Export the image again.")
    if missing:
        first = tuple(map(int, np.unravel_index(int(np.argmin(finite)), values.shape)))
        problem = f"{missing} of {values.size} voxels are NaN or infinite, the first at index {first}"
        if not allow_missing:
            raise InputError(
                f"{path}: {problem}. Repair the image, or treat these voxels as missing: `allow_missing` "
                "(--allow-missing on the command line)."
            )
        _log.warning("%s: %s; treated as missing", path, problem)
        values = np.where(finite, values, np.float32(np.nan))
    low = np.nanmin(values)
    if low == np.nanmax(values):
        raise ImageFileError(
            f"{path}: the image is constant (all voxels are {float(low):g}); it cannot be registered. Export it again."
        )
    return Image(grid, values)


@checked
def read_voxels(
    path: StrPath, *, series: str | None = None, volume: int | None = None, max_bytes: int = MAX_BYTES
) -> tuple[Grid, Voxels]:
    """Grid (LPS mm) and voxels (ni, nj, nk), unchecked, in the file's own number type; otherwise as `read_image`."""
    place = Path(path)
    if not place.exists():
        raise InputError(missing(place))
    if place.is_dir() or (_known_suffix(place.name) is None and is_dicom(place)):
        if volume is not None:
            raise InputError(f"{place}: volume={volume} is for 4D files; for DICOM use series.")
        grid, voxels = read_dicom(place, series=series, max_bytes=max_bytes)
        _refuse_size_of_no_body(place, grid, "mm")
        return grid, voxels
    if series is not None:
        raise InputError(f"{place}: series='{series}' is only for DICOM files and folders; this is neither.")
    stored = read_header(place, volume=volume, max_bytes=max_bytes)
    if stored.unit != "mm":
        _log.warning("%s: lengths converted from %s to mm", place, stored.unit)
    _refuse_size_of_no_body(place, stored.grid, stored.unit)
    return stored.grid, stored.load()


def _refuse_size_of_no_body(place: Path, grid: Grid, unit: str) -> None:
    edges = grid.spacing_mm
    if edges.max() > _MOST_UNLIKE * edges.min():
        raise ImageFileError(
            f"{place}: by its header, the voxels are {' x '.join(f'{edge:.3g}' for edge in edges)} mm, with edges that "
            f"differ by a factor of {edges.max() / edges.min():.0f}. Some of them are probably in another unit, such "
            "as metres. Correct the header."
        )
    longest = float((edges * grid.shape).max())
    if not _SMALLEST_MM <= longest <= _LARGEST_MM:
        size = f"{longest / 1000.0:.3g} m" if longest > _LARGEST_MM else f"{longest:.2g} mm"
        likely = "mm" if unit != "mm" else "micrometres" if longest > _LARGEST_MM else "metres"
        raise ImageFileError(
            f"{place}: according to its header (unit {unit}), the image is {size} across, which is impossible for a "
            f"body part. Its voxel sizes are probably in {likely}. Correct the header."
        )


def read_header(
    path: Path, *, volume: int | None = None, max_bytes: int = MAX_BYTES, vectors: bool = False, components: int = 3
) -> StoredVolume:
    """Read what a file holds, its voxels not yet read: scalars, or with `vectors` so many `components` per voxel."""
    suffix = _known_suffix(path.name)
    if suffix is None:
        known = f"{', '.join(_FORMATS)}, enhanced DICOM files and folders of DICOM files"
        raise ImageFileError(f"{path}: this image format is not supported. Supported: {known}.")
    return _FORMATS[suffix][1](path, volume, max_bytes, vectors, components)


def format_of(name: str) -> str:
    """Format of an image that was read, by its name alone; a folder's, and a file's of no other format, is DICOM."""
    suffix = _known_suffix(name)
    return "DICOM" if suffix is None else _FORMATS[suffix][0]


def _known_suffix(name: str) -> str | None:
    return next((s for s in sorted(_FORMATS, key=len, reverse=True) if name.lower().endswith(s)), None)
