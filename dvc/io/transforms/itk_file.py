"""Transform files of ITK: text (.tfm, .txt), Matlab (.mat) and HDF5 (.h5), read by ITK once they are known to be whole.

ITK takes a file that was cut, with less in it. On a damaged HDF5 file its library may crash or never return, so these
are read in a process of their own, which costs about a second.
"""

import math
import os
import re
import struct
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import SimpleITK as sitk

from dvc.arrays import FloatArray, numbers
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Affine, Composed, Deformation, RigidMotion, SampledDisplacement
from dvc.errors import InputError, WorkerError
from dvc.file_names import is_utf8
from dvc.images.itk_image import from_sitk as image_from_sitk
from dvc.worker import Worker

_HDF5_SUFFIXES = (".h5", ".hdf5")
_SUFFIXES = (*_HDF5_SUFFIXES, ".tfm", ".mat")
_TEXT = b"#Insight Transform File"

_HDF5 = b"\x89HDF\r\n\x1a\n"
_OF_HDF5 = {0: (13, 40), 1: (13, 44), 2: (9, 28), 3: (9, 28)}  # by version: where the width and the file's length are
_MOST_S, _BYTES_PER_S = 30.0, 5e6
_KIND = re.compile(r"(\w+)_(?:double|float)_(\d)_(\d)", re.ASCII)
_ON_A_GRID = ("BSplineTransform", "DisplacementFieldTransform")
_MATLAB_TYPES = {0: "<f8", 10: "<f4"}


class _Stored(NamedTuple):
    """One transform as a file lists it."""

    kind: str
    parameters: FloatArray | None
    fixed: FloatArray | None


def is_itk_transform(path: Path) -> bool:
    """Whether a file is one of ITK's, by its name or its first line."""
    if path.suffix.lower() in _SUFFIXES:
        return True
    with path.open("rb") as file:
        return file.read(len(_TEXT)) == _TEXT


def read_itk_transform(path: Path) -> Deformation:
    """Read a file of ITK; InputError if it is damaged, cut, not 3D or of a kind that is not supported."""
    try:
        if not is_utf8(path):  # ITK would end the process
            raise InputError("ITK opens only paths in UTF-8. Rename the folder or the file.")
        if path.suffix.lower() in _HDF5_SUFFIXES:
            _refuse_other_length(path)
            return _read_in_a_worker(path)
        _refuse_incomplete(_of_matlab(path) if path.suffix.lower() == ".mat" else _of_text(path))
        return _read(path)
    except InputError as wrong:
        raise InputError(f"{path}: {wrong}") from wrong
    except (OSError, RuntimeError, ValueError, KeyError, OverflowError, struct.error) as failure:
        reason = (str(failure).strip().splitlines() or [type(failure).__name__])[-1].strip()[:120]
        what = f"cannot be read as an ITK transform file ({reason})"
        raise InputError(f"{path}: {what}. Copy or export it again.") from failure


def flat(deformation: Deformation) -> tuple[Deformation, ...]:
    """The parts of a composition, or the deformation alone."""
    return deformation.parts if isinstance(deformation, Composed) else (deformation,)


def _of_text(path: Path) -> list[_Stored]:
    text = path.read_text(encoding="utf-8")
    if not text.endswith("\n"):
        raise InputError(
            "the last line has no end, so the file may have been cut. Copy it again, or end it with a line break if it "
            "is whole."
        )
    found: list[dict[str, Any]] = []
    for line in text.splitlines():
        name, _, value = line.partition(":")
        if not line.strip() or line.startswith("#"):
            continue
        if name == "Transform":
            found.append({name: value.strip()})
        elif name in ("Parameters", "FixedParameters") and found and name not in found[-1]:
            found[-1][name] = numbers(value.split())
        else:
            raise InputError(f"the file is damaged (unexpected line '{line[:40]}'). Copy or export it again.")
    return [_Stored(f["Transform"], f.get("Parameters"), f.get("FixedParameters")) for f in found]


def _of_matlab(path: Path) -> list[_Stored]:
    """The transforms of a Matlab file, level 4: columns of numbers, one named as the transform, the next "fixed"."""
    data, at, columns = path.read_bytes(), 0, []
    while at < len(data):
        number, rows, width, imaginary, length = struct.unpack_from("<5i", data, at)
        if min(rows, length) < 0 or width != 1 or imaginary != 0:
            raise ValueError("a header that is not one of numbers in a column")
        begin = at + 20 + length
        values = np.frombuffer(data, _MATLAB_TYPES[number], rows, begin).astype(np.float64)
        columns.append((data[at + 20 : begin].rstrip(b"\0").decode("ascii"), values))
        at = begin + rows * np.dtype(_MATLAB_TYPES[number]).itemsize
    if [name for name, _ in columns[1::2]] != ["fixed"] * (len(columns) // 2) or len(columns) % 2:
        raise ValueError("transforms without their fixed parameters")
    return [_Stored(kind, of, fixed) for (kind, of), (_, fixed) in zip(columns[::2], columns[1::2], strict=True)]


def _refuse_incomplete(stored: list[_Stored]) -> None:
    """Refuse transforms that lack numbers, or have more: ITK would leave out the transform, or the numbers."""
    if all(kind.startswith("Composite") for kind, _, _ in stored):
        raise InputError("the file is incomplete: it has no transform. Copy or export it again.")
    for kind, parameters, fixed in stored:
        name = _KIND.fullmatch(kind)
        if name is None:
            raise InputError(f"the file is damaged ({kind[:40]!r} is no transform). Copy or export it again.")
        if name[2] != "3":
            raise InputError(f"a {name[2]}D transform; a 3D one is needed.")
        if kind.startswith("Composite") and parameters is None and fixed is None:
            continue
        if parameters is None or fixed is None:
            raise InputError(f"the file is incomplete: the {name[1]} lacks numbers. Copy or export it again.")
        if not (np.isfinite(parameters).all() and np.isfinite(fixed).all()):
            raise InputError(f"the {name[1]} has numbers that are not finite. Copy or export the file again.")
        if name[1] in _ON_A_GRID:
            sizes = fixed[:3]
            whole = len(fixed) == 18 and np.all((sizes >= 1) & (sizes == np.floor(sizes)))
            if not whole or 3 * math.prod(map(int, sizes)) != len(parameters):
                raise InputError(
                    f"the file is damaged: the {name[1]} has {len(parameters)} numbers on a grid of {sizes.tolist()}. "
                    "Copy or export it again."
                )


def _refuse_other_length(path: Path) -> None:
    """Refuse an HDF5 file whose length is not the one in its first block."""
    with path.open("rb") as file:
        start = file.read(64)
    if len(start) < 64 or start[: len(_HDF5)] != _HDF5 or start[8] not in _OF_HDF5:
        raise ValueError("no HDF5 file")
    width, length = _OF_HDF5[start[8]]
    (stored,), size = struct.unpack_from("<Q", start, length), path.stat().st_size
    if start[width] != 8 or stored != size:
        raise InputError(
            f"the file is incomplete or damaged: it has {size} bytes and should have {stored}. Copy or export it again."
        )


def _read_in_a_worker(path: Path) -> Deformation:
    over = np.inf

    def watch() -> None:
        if time.monotonic() > over:
            raise InputError("reading it timed out; the file is probably damaged. Copy or export it again.")

    with Worker(threads=1) as worker:
        try:
            worker.start(__name__)
            worker.run(f"reading {path.name}", int)  # the time counts once the process is there
            over = time.monotonic() + _MOST_S + path.stat().st_size / _BYTES_PER_S
            return worker.run(f"reading {path.name}", _read, path, watch=watch)
        except WorkerError as died:
            raise InputError(
                "reading it ended the process: the file is damaged, or there is too little memory. Copy or export it "
                "again."
            ) from died


def _read(path: Path) -> Deformation:
    return _from_sitk(sitk.ReadTransform(os.fspath(path)))


def _from_sitk(transform: Any) -> Deformation:
    transform = transform.Downcast()
    if transform.GetDimension() != 3:
        raise InputError(f"a {transform.GetDimension()}D transform; a 3D one is needed.")
    if isinstance(transform, sitk.CompositeTransform):  # the one added last acts first
        parts = [transform.GetNthTransform(n) for n in reversed(range(transform.GetNumberOfTransforms()))]
        pieces = [piece for part in parts for piece in flat(_from_sitk(part))]
        return pieces[0] if len(pieces) == 1 else Composed(pieces or [RigidMotion.identity()])
    if isinstance(transform, sitk.BSplineTransform):
        if transform.GetOrder() != 3:
            raise InputError(f"a B-spline of order {transform.GetOrder()}; only cubic B-splines are supported.")
        images = [image_from_sitk(image) for image in transform.GetCoefficientImages()]
        coefficients = np.stack([values for _, values in images]).astype(np.float64, copy=False)
        if not np.isfinite(coefficients).all():
            raise InputError("the B-spline has coefficients that are not finite. Copy or export the file again.")
        return BSpline(images[0][0], coefficients)
    if isinstance(transform, sitk.DisplacementFieldTransform):
        grid, u = image_from_sitk(transform.GetDisplacementField())
        if np.isinf(u).any():
            raise InputError("the displacement field has infinite values. Unknown displacements must be NaN.")
        return SampledDisplacement(grid, u.astype(np.float64, copy=False))
    if isinstance(transform, sitk.TranslationTransform):
        return Affine(np.eye(3), np.array(transform.GetOffset()))
    if transform.GetTransformEnum() == sitk.sitkIdentity:
        return RigidMotion.identity()
    if not hasattr(transform, "GetMatrix"):
        raise InputError(f"transforms of the kind {transform.GetName()} are not supported.")
    matrix = np.reshape(transform.GetMatrix(), (3, 3))
    shift = transform.GetTranslation() if hasattr(transform, "GetTranslation") else np.zeros(3)
    rigid = isinstance(transform, sitk.Euler3DTransform | sitk.VersorRigid3DTransform | sitk.VersorTransform)
    return (RigidMotion if rigid else Affine).about(np.array(transform.GetCenter()), matrix, np.array(shift))
