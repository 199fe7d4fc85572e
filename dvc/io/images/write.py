"""Writing images, masks, label maps and vector fields: NIfTI, NRRD and MetaImage.

Headers are made anew and hold geometry only, so nothing of a patient can pass from an input to an output. A
file appears under its name when it is whole: it is written beside it and then renamed.

Missing values are NaN. Programs built on ITK (Slicer, ITK-SNAP, SimpleITK) show a NaN of a NIfTI file as
zero, but not one of an NRRD file or a MetaImage: give them one of those, or the mask of what is defined.

References
----------
.. [1] NIfTI-1 intent codes: https://nifti.nimh.nih.gov/nifti-1/documentation/nifti1fields
"""

from __future__ import annotations

import csv
import io
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import IO, Any

import nibabel
import numpy as np
import numpy.typing as npt

from dvc.atomic_files import whole_file, write_whole
from dvc.errors import InputError, OutputError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.io.images.nifti import LPS_FROM_RAS
from dvc.trust.verdict import Verdict

StrPath = str | PathLike[str]

_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha")
_LEVEL = 1  # floats hardly shrink at higher levels, which take several times as long
_BLOCK = 1 << 22
_NIFTI_VECTOR = 1007
_NRRD_TYPES = {"f4": "float", "u1": "uint8", "u2": "uint16", "i4": "int32"}
_META_TYPES = {"f4": "MET_FLOAT", "u1": "MET_UCHAR", "u2": "MET_USHORT", "i4": "MET_INT"}


def write_image(path: StrPath, image: Image) -> None:
    """Write an image in single precision; missing voxels are NaN in the file.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd or .mha
        NIfTI gets equal qform and sform (code 1, mm, RAS); the others are in LPS.

    Raises
    ------
    OutputError
        If the file cannot be written; nothing is left under its name.

    Examples
    --------
    >>> import tempfile
    >>> from dvc.io.images.read import read_image
    >>> image = Image(Grid((4, 5, 6), (1.0, 1.0, 2.0), (0.0, 0.0, 0.0)), np.arange(120.0).reshape(4, 5, 6))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(Path(folder) / "a.nii.gz", image)
    ...     back = read_image(Path(folder) / "a.nii.gz")
    >>> bool((back.values == image.values).all()), back.grid.same_as(image.grid)
    (True, True)
    """
    _write(Path(path), image.grid, image.values)


def write_mask(path: StrPath, mask: Mask) -> None:
    """Write a mask as 0 and 1. Formats and errors as `write_image`."""
    _write(Path(path), mask.grid, mask.inside.view(np.uint8))


def write_labels(path: StrPath, labels: LabelMap) -> None:
    """Write a label map, and its names in a table beside it: stem and ``.csv``, columns label and name.

    Formats and errors as `write_image`.
    """
    place = Path(path)
    largest = int(labels.labels.max())
    dtype = np.uint8 if largest < 2**8 else np.uint16 if largest < 2**16 else np.int32
    if largest >= 2**31:
        raise OutputError(f"{place}: label {largest} is too large for the file format; number the labels anew.")
    _write(place, labels.grid, labels.labels.astype(dtype))
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["label", "name"])
    writer.writerows(sorted(labels.names.items()))
    write_whole(_beside(place, ".csv"), table.getvalue())


def write_vectors(
    path: StrPath,
    grid: Grid,
    values: npt.ArrayLike,
    components: tuple[str, ...],
    meaning: str,
    frame: str = "LPS",
    *,
    unit: str,
    verdict: Verdict | None = None,
) -> None:
    """Write several values per voxel of the reference image, and what they mean in a JSON file beside it.

    NIfTI: 5D, (ni, nj, nk, 1, c). Three components in the frame LPS get the intent "vector" (1007) [1]_; the
    affine is RAS as always, so that a reader must take the components' frame from the JSON file. Everything
    else, such as symmetric tensors in the order xx, xy, xz, yy, yz, zz, has no intent: NIfTI's own order of
    these is another.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd or .mha
        The JSON file has the same stem.
    values : (ni, nj, nk, c)
        NaN where not defined.
    components : names of the c components
    meaning : what is written, in a line
    frame : "LPS", or "invariant" for components that no frame changes
    unit : "mm", "1", ...
    verdict : Verdict, optional
        Whether the values may be trusted; told in the JSON file.

    Raises
    ------
    InputError
        If shapes, names and frame do not fit together.
    OutputError
        If a file cannot be written; nothing is left under its name.
    """
    place, array = Path(path), np.asarray(values)
    if array.shape != (*grid.shape, len(components)):
        raise InputError(
            f"{place}: values have shape {array.shape}; the grid and {len(components)} components need "
            f"{(*grid.shape, len(components))}."
        )
    if frame not in ("LPS", "invariant"):
        raise InputError(f"{place}: frame '{frame}'; components are written in LPS, or are invariant.")
    vector = frame == "LPS" and len(components) == 3
    _write(place, grid, array.astype(np.float32, copy=False), vector=vector)
    declared: dict[str, object] = {
        "file": place.name,
        "meaning": meaning,
        "components": list(components),
        "frame": frame,
        "unit": unit,
        "configuration": "reference",
        "missing": "NaN",
    }
    if verdict is not None:
        declared["verdict"] = verdict.as_dict()
    write_whole(_beside(place, ".json"), json.dumps(declared, indent=2) + "\n")


def refuse_overwriting_inputs(outputs: Iterable[StrPath], inputs: Iterable[StrPath]) -> None:
    """Refuse outputs that are one of the inputs, or lie in a folder that is one (a DICOM series).

    Links are followed, so another name of the same file counts too.

    Raises
    ------
    OutputError
        Naming the output and the input.
    """
    sources = [Path(p) for p in inputs]
    for output in map(Path, outputs):
        there = output.resolve()
        for source in sources:
            same = there == source.resolve() or (output.exists() and source.exists() and output.samefile(source))
            if same or (source.is_dir() and source.resolve() in there.parents):
                raise OutputError(
                    f"{output}: this output would overwrite or lie within the input {source}. Choose "
                    "another file or folder for the outputs."
                )


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name[: -len(_format(path))] + suffix)


def _format(path: Path) -> str:
    for suffix in _SUFFIXES:
        if path.name.lower().endswith(suffix) and len(path.name) > len(suffix):
            return suffix
    raise OutputError(f"{path}: files of this kind are not written; the suffixes are {', '.join(_SUFFIXES)}.")


def _write(path: Path, grid: Grid, values: npt.NDArray[Any], vector: bool = False) -> None:
    suffix = _format(path)
    values = values.astype(values.dtype.newbyteorder("<"), copy=False)
    makers: dict[str, Callable[[Grid, npt.NDArray[Any], bool], bytes]] = {".nrrd": _nrrd, ".mha": _meta}
    # NRRD and MetaImage keep the components of a voxel together, NIfTI one volume after the other.
    together = suffix in makers
    with whole_file(path) as part, part.open("wb") as file:
        header = makers.get(suffix, _nifti)(grid, values, vector)
        parts = _blocks(values, together)
        if suffix == ".nrrd":
            file.write(header)
            _deflate(file, parts)
        elif suffix == ".nii.gz":
            _deflate(file, _chained(header, parts))
        else:
            for block in _chained(header, parts):
                file.write(block)


def _chained(header: bytes, parts: Iterator[bytes]) -> Iterator[bytes]:
    yield header
    yield from parts


def _blocks(values: npt.NDArray[Any], together: bool) -> Iterator[bytes]:
    """Yield the voxels, first axis fastest, a few slices at a time."""
    if values.ndim == 4 and not together:
        for c in range(values.shape[3]):
            yield from _blocks(values[..., c], together)
        return
    per_slice = max(values[:, :, 0].nbytes, 1)
    step = max(_BLOCK // per_slice, 1)
    for k in range(0, values.shape[2], step):
        part = values[:, :, k : k + step]
        yield np.ascontiguousarray(part.transpose(2, 1, 0, *range(3, values.ndim))).tobytes()


def _deflate(file: IO[bytes], parts: Iterable[bytes]) -> None:
    """Write a gzip stream without name and time, so that equal images give equal files."""
    coder = zlib.compressobj(_LEVEL, wbits=31)
    for part in parts:
        file.write(coder.compress(part))
    file.write(coder.flush())


def _nifti(grid: Grid, values: npt.NDArray[Any], vector: bool) -> bytes:
    header = nibabel.Nifti1Header()
    try:
        header.set_data_shape(grid.shape if values.ndim == 3 else (*grid.shape, 1, values.shape[3]))
    except Exception as error:
        raise OutputError(f"NIfTI cannot hold {grid.shape} voxels; write .nrrd instead.") from error
    header.set_data_dtype(values.dtype)
    affine = LPS_FROM_RAS @ grid.affine
    header.set_qform(affine, code=1)
    header.set_sform(affine, code=1)
    header.set_xyzt_units("mm")
    header["scl_slope"], header["scl_inter"] = 1.0, 0.0
    header["intent_code"] = _NIFTI_VECTOR if vector else 0
    header["vox_offset"] = 352
    header["magic"] = b"n+1"
    return bytes(header.binaryblock) + bytes(4)


def _nrrd(grid: Grid, values: npt.NDArray[Any], vector: bool) -> bytes:
    several = values.ndim == 4
    directions = [f"({','.join(repr(float(v)) for v in column)})" for column in grid.affine[:3, :3].T]
    sizes = ([values.shape[3]] if several else []) + list(grid.shape)
    first = (["vector"] if vector else ["list"]) if several else []
    lines = [
        "NRRD0005",
        f"type: {_NRRD_TYPES[values.dtype.str[1:]]}",
        f"dimension: {len(sizes)}",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, sizes))}",
        f"space directions: {' '.join((['none'] if several else []) + directions)}",
        f"kinds: {' '.join([*first, 'domain', 'domain', 'domain'])}",
        "endian: little",
        "encoding: gzip",
        'space units: "mm" "mm" "mm"',
        f"space origin: ({','.join(repr(float(v)) for v in grid.origin_mm)})",
    ]
    return ("\n".join(lines) + "\n\n").encode()


def _meta(grid: Grid, values: npt.NDArray[Any], vector: bool) -> bytes:
    del vector  # MetaImage has no word for it

    def numbers(array: npt.NDArray[Any]) -> str:
        return " ".join(repr(float(v)) for v in array.ravel())

    lines = [
        "ObjectType = Image",
        "NDims = 3",
        "BinaryData = True",
        "BinaryDataByteOrderMSB = False",
        "CompressedData = False",
        f"TransformMatrix = {numbers(grid.direction.T)}",
        f"Offset = {numbers(grid.origin_mm)}",
        "CenterOfRotation = 0 0 0",
        f"ElementSpacing = {numbers(grid.spacing_mm)}",
        f"DimSize = {' '.join(map(str, grid.shape))}",
        *([f"ElementNumberOfChannels = {values.shape[3]}"] if values.ndim == 4 else []),
        f"ElementType = {_META_TYPES[values.dtype.str[1:]]}",
        "ElementDataFile = LOCAL",
    ]
    return ("\n".join(lines) + "\n").encode()
