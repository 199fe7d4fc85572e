"""Writing images, masks, label maps and vector fields: NIfTI, NRRD and MetaImage.

Headers are written from the geometry alone, so that nothing of a patient passes from an input to an output.

Missing values are NaN. Programs built on ITK (Slicer, ITK-SNAP, SimpleITK) show a NaN of a NIfTI file as zero, but not
that of an NRRD file or a MetaImage: give them one of those, or the mask of valid voxels.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from dvc.arguments import checked
from dvc.atomic_files import whole_file, write_csv, write_json
from dvc.errors import InputError, OutputError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.io import StrPath
from dvc.io.images.nifti import LPS_FROM_RAS
from dvc.trust.verdict import Verdict

_SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".mha")
_LEVEL = 1  # floats hardly shrink at higher levels
_BLOCK = 1 << 22
_NRRD_TYPES = {"f4": "float", "u1": "uint8", "u2": "uint16", "i4": "int32"}
_META_TYPES = {"f4": "MET_FLOAT", "u1": "MET_UCHAR", "u2": "MET_USHORT", "i4": "MET_INT"}


@checked
def write_image(path: StrPath, image: Image) -> None:
    """Write an image in single precision; missing voxels are NaN in the file.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd or .mha
        NIfTI gets equal qform and sform (code 1, mm, RAS); the others are in LPS.
    image : Image
        Values (ni, nj, nk) on a grid in LPS mm.

    Raises
    ------
    InputError
        If an argument is of another kind, such as an array: make it an image on a grid first.
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


@checked
def write_mask(path: StrPath, mask: Mask) -> None:
    """Write a mask as 0 and 1, in 8 bits.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd or .mha
        Frames as in `write_image`.
    mask : Mask
        Voxels (ni, nj, nk) on a grid of its own, LPS mm.

    Raises
    ------
    InputError, OutputError
        If an argument is of another kind; if the file cannot be written, and nothing is left under its name.
    """
    _write(Path(path), mask.grid, mask.inside.view(np.uint8))


@checked
def write_labels(path: StrPath, labels: LabelMap) -> None:
    """Write a label map, and its names in a table beside it: stem and ``.csv``, columns label and name.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd or .mha
        Frames as in `write_image`.
    labels : LabelMap
        Labels (ni, nj, nk) on a grid in LPS mm, written in 8, 16 or 32 bits, the fewest that hold them.

    Raises
    ------
    InputError
        If an argument is of another kind.
    OutputError
        If a label is 2**31 or more, or a file cannot be written; nothing is left under its name.
    """
    place, largest = Path(path), int(labels.labels.max())
    dtype = np.min_scalar_type(largest) if largest < 2**16 else np.int32
    if largest >= 2**31:
        raise OutputError(f"{place}: label {largest} is too large for the file format; renumber the labels.")
    _write(place, labels.grid, labels.labels.astype(dtype))
    write_csv(_beside(place, ".csv"), ("label", "name"), sorted(labels.names.items()))


@checked
def write_vectors(
    path: StrPath, grid: Grid, values: npt.ArrayLike, components: Sequence[str], meaning: str, frame: str = "LPS", *,
    unit: str, verdict: Verdict | None = None,
) -> None:  # fmt: skip
    """Write several values per voxel of the reference image, and a JSON file beside them that says what they are.

    NIfTI: 5D, (ni, nj, nk, 1, c). Three components in the frame LPS get the intent "vector" (1007) [1]_; the affine is
    RAS as always, so that a reader must take the components' frame from the JSON file. Everything else, such as
    symmetric tensors in the order xx, xy, xz, yy, yz, zz, has no intent: NIfTI's own order of these is another.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd or .mha
        The JSON file has the same stem.
    grid : Grid
        Of the reference image, LPS mm.
    values : (ni, nj, nk, c)
        Real numbers, written in single precision; NaN where not defined.
    components : names of the c components
    meaning : what is written, in a line
    frame : "LPS", or "invariant" for components that do not depend on the frame
    unit : "mm", "1", ...
    verdict : Verdict, optional
        Whether the values may be trusted; goes into the JSON file.

    Raises
    ------
    InputError
        If shapes, names and frame do not fit together, or an argument is of another kind.
    OutputError
        If a file cannot be written; nothing is left under its name.

    References
    ----------
    .. [1] NIfTI-1 intent codes: https://nifti.nimh.nih.gov/nifti-1/documentation/nifti1fields
    """
    place, array = Path(path), np.asarray(values)
    needed = (*grid.shape, len(components))
    if array.shape != needed:
        what = f"the grid and {len(components)} components need {needed}"
        raise InputError(f"{place}: values have shape {array.shape}; {what}.")
    if array.dtype.kind not in "biuf":
        raise InputError(f"values must be real numbers; got {array.dtype}.")
    if frame not in ("LPS", "invariant"):
        raise InputError(f"{place}: the frame of the components must be LPS or invariant; got '{frame}'.")
    vector = frame == "LPS" and len(components) == 3
    _write(place, grid, array.astype(np.float32, copy=False), vector=vector)
    declared: dict[str, object] = {"file": place.name, "meaning": meaning, "components": [*components], "frame": frame}
    declared |= {"unit": unit, "configuration": "reference", "missing": "NaN"}
    write_json(_beside(place, ".json"), declared | ({} if verdict is None else {"verdict": verdict.as_dict()}))


def refuse_overwriting_inputs(outputs: Iterable[StrPath], inputs: Iterable[StrPath]) -> None:
    """Refuse outputs that are one of the inputs (links followed), or lie in a folder that is one (a DICOM series)."""
    sources = [Path(p) for p in inputs]
    for output in map(Path, outputs):
        there = output.resolve()
        for source in sources:
            same = there == source.resolve() or (output.exists() and source.exists() and output.samefile(source))
            if same or (source.is_dir() and source.resolve() in there.parents):
                problem = f"this output would overwrite the input {source}, or would be inside it"
                raise OutputError(f"{output}: {problem}. Choose another output file or folder.")


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name[: -len(_format(path))] + suffix)


def _format(path: Path) -> str:
    for suffix in _SUFFIXES:
        if path.name.lower().endswith(suffix) and len(path.name) > len(suffix):
            return suffix
    raise OutputError(f"{path}: this output format is not supported; use {', '.join(_SUFFIXES)}.")


def _write(path: Path, grid: Grid, values: npt.NDArray[Any], vector: bool = False) -> None:
    suffix = _format(path)
    values = values.astype(values.dtype.newbyteorder("<"), copy=False)
    together = suffix in (".nrrd", ".mha")  # components of a voxel; NIfTI has one volume after the other
    header = {".nrrd": _nrrd, ".mha": _meta}.get(suffix, _nifti)(grid, values, vector)
    stream = chain([] if suffix == ".nrrd" else [header], _blocks(values, together))
    with whole_file(path) as part, part.open("wb") as file:
        if suffix == ".nrrd":
            file.write(header)
        if suffix in (".nrrd", ".nii.gz"):  # gzip without name and time, so that equal images give equal files
            coder = isal_zlib.compressobj(_LEVEL, wbits=31)
            file.writelines(map(coder.compress, stream))
            file.write(coder.flush())
        else:
            file.writelines(stream)


def _blocks(values: npt.NDArray[Any], together: bool) -> Iterator[bytes]:
    """Yield the voxels, first axis fastest, a few slices at a time."""
    for volume in [values] if together or values.ndim == 3 else np.moveaxis(values, 3, 0):
        step = max(_BLOCK // max(volume[:, :, 0].nbytes, 1), 1)
        for k in range(0, volume.shape[2], step):
            yield volume[:, :, k : k + step].transpose(2, 1, 0, *range(3, volume.ndim)).tobytes()


def _nifti(grid: Grid, values: npt.NDArray[Any], vector: bool) -> bytes:
    header = nibabel.Nifti1Header()
    try:
        header.set_data_shape(grid.shape if values.ndim == 3 else (*grid.shape, 1, values.shape[3]))
    except Exception as error:
        raise OutputError(f"NIfTI does not allow {grid.shape} voxels; write .nrrd instead.") from error
    header.set_data_dtype(values.dtype)
    affine = LPS_FROM_RAS @ grid.affine
    header.set_qform(affine, code=1)
    header.set_sform(affine, code=1)
    header.set_xyzt_units("mm")
    header["scl_slope"], header["scl_inter"] = 1.0, 0.0
    header["intent_code"] = 1007 if vector else 0  # "vector"
    header["vox_offset"], header["magic"] = 352, b"n+1"
    return bytes(header.binaryblock) + bytes(4)


def _nrrd(grid: Grid, values: npt.NDArray[Any], vector: bool) -> bytes:
    count, kind = [*values.shape[3:]], "vector" if vector else "list"
    directions = ["none" for _ in count] + [f"({_numbers(step, ',')})" for step in grid.affine[:3, :3].T]
    fields = {
        "type": _NRRD_TYPES[values.dtype.str[1:]], "dimension": str(len(directions)),
        "space": "left-posterior-superior", "sizes": " ".join(map(str, (*count, *grid.shape))),
        "space directions": " ".join(directions),
        "kinds": " ".join([*(kind for _ in count), "domain", "domain", "domain"]),
        "endian": "little", "encoding": "gzip",
        "space units": '"mm" "mm" "mm"', "space origin": f"({_numbers(grid.origin_mm, ',')})",
    }  # fmt: skip
    return ("\n".join(["NRRD0005", *map(": ".join, fields.items())]) + "\n\n").encode()


def _meta(grid: Grid, values: npt.NDArray[Any], vector: bool) -> bytes:
    del vector  # MetaImage has no word for it
    count = {"ElementNumberOfChannels": str(values.shape[3])} if values.ndim == 4 else {}
    fields = {
        "ObjectType": "Image", "NDims": "3",
        "BinaryData": "True", "BinaryDataByteOrderMSB": "False", "CompressedData": "False",
        "TransformMatrix": _numbers(grid.direction.T), "Offset": _numbers(grid.origin_mm), "CenterOfRotation": "0 0 0",
        "ElementSpacing": _numbers(grid.spacing_mm), "DimSize": " ".join(map(str, grid.shape)),
        **count, "ElementType": _META_TYPES[values.dtype.str[1:]], "ElementDataFile": "LOCAL",
    }  # fmt: skip
    return ("\n".join(map(" = ".join, fields.items())) + "\n").encode()


def _numbers(array: npt.NDArray[Any], mark: str = " ") -> str:
    return mark.join(repr(float(v)) for v in array.ravel())
