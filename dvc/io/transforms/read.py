"""Transforms of elastix and ITK, and displacement images, read to a Deformation: fixed to moving points, LPS mm."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc.arguments import checked
from dvc.arrays import FloatArray, numbers
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Affine, Composed, Deformation, RigidMotion, SampledDisplacement
from dvc.errors import ImageFileError, InputError, ParameterError
from dvc.images.image import Grid
from dvc.io import StrPath
from dvc.io.images.read import read_header
from dvc.io.images.text_headers import nrrd_fields
from dvc.io.transforms.elastix_text import Parameters, parse_parameters
from dvc.io.transforms.interface_spline import read_interface_spline
from dvc.io.transforms.itk_file import flat, is_itk_transform, read_itk_transform
from dvc.own_files import read_json

_NO_INITIAL = "NoInitialTransform"
_SAME_CONTROL = 1e-6
_MOST_POINTS = 100_000  # along an axis of control points


@dataclass(frozen=True, slots=True, eq=False)
class Added:
    """Displacements added at the same point: u(X) = u_1(X) + u_2(X) + ..., elastix' combination "Add"."""

    parts: tuple[Deformation, ...]

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm; NaN where any part is undefined."""
        return np.asarray(sum(part.displacement(points_mm) for part in self.parts))

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H (n, 3, 3), the sum of the parts'; NaN where any part is undefined."""
        evaluated = [part.evaluate(points_mm) for part in self.parts]
        return np.asarray(sum(u for u, _ in evaluated)), np.asarray(sum(H for _, H in evaluated))


@checked
def read_transform(path: StrPath) -> Deformation:
    """Read a transform file: elastix' TransformParameters (.txt), ITK's (.h5, .tfm, .mat, .txt), or ours (.npz).

    elastix' chain of initial transforms is followed, combined as each file says: "Compose" (T(x) = T1(T0(x))) or
    "Add".

    Parameters
    ----------
    path : path
        The last file of a chain; the name of an initial transform is looked for beside the file that names it.

    Returns
    -------
    Deformation
        Maps fixed points to moving points, LPS mm. A `BSpline` is NaN outside its valid region, where elastix and ITK
        return the identity. A displacement field in an ITK file is interpolated by cubic splines (in ITK: linearly).

    Raises
    ------
    InputError
        If the file is missing, damaged, not 3D or of a kind that is not read, or ``path`` is no path.
    ParameterError
        If an elastix file contradicts itself or lacks something.
    """
    place = Path(path)
    if not place.is_file():
        raise InputError(f"{place}: no such transform file. Check the path.")
    if place.suffix.lower() == ".npz":
        return read_interface_spline(place)
    if is_itk_transform(place):
        return read_itk_transform(place)
    return _read_elastix(place, ())


@checked
def read_displacement(path: StrPath, frame: str | None = None) -> SampledDisplacement:
    """Read a displacement image, in mm: three components per voxel (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd).

    Parameters
    ----------
    path : path
        Its ending gives the format; the image's geometry is that of the reference configuration.
    frame : {"LPS", "RAS"}, optional
        Frame of the components. Where the file, or the JSON file of the same stem beside it (key "frame"), gives the
        frame too, both must agree. MetaImage is LPS, NRRD is LPS where its space is; NIfTI files differ by the
        program that wrote them, so that it must be given.

    Returns
    -------
    SampledDisplacement
        On the grid of the image; voxels that are NaN are undefined.

    Raises
    ------
    InputError
        If there is no such file, or an argument is of another kind.
    ImageFileError
        If the file is damaged, not a 3D image of three components, in another unit than mm, or holds infinite
        values, or if its geometry or frame is missing or contradictory.
    """
    place = Path(path)
    if not place.is_file():
        raise InputError(f"{place}: no such displacement image. Check the path.")
    declared = {frame, _frame_beside(place)}
    try:
        stored = read_header(place, vectors=True)
        if stored.unit != "mm":
            raise ImageFileError(f"{place}: lengths are in {stored.unit}; a displacement in mm is needed.")
        declared |= {_frame_of_header(place)}
        values = stored.load()
    except OSError as failure:
        raise ImageFileError(f"{place}: cannot be read as a displacement image ({failure}).") from failure
    frames = sorted(f for f in declared if f is not None)
    if len(frames) != 1 or frames[0] not in ("LPS", "RAS"):
        raise ImageFileError(
            f"{place}: the frame of the components must be LPS or RAS, without contradiction; found "
            f"{frames or 'none'}. Pass frame (--frame on the command line), or set 'frame' in the JSON file of the "
            "same name."
        )
    infinite = np.isinf(values).any(axis=-1)
    if infinite.any():
        first = tuple(np.argwhere(infinite)[0].tolist())
        raise ImageFileError(
            f"{place}: the displacement of {int(infinite.sum())} of {infinite.size} voxels is infinite, the first at "
            f"index {first}. Unknown displacements must be NaN. Repair the file, or write it again."
        )
    signs = np.array([1.0, 1.0, 1.0] if frames[0] == "LPS" else [-1.0, -1.0, 1.0])
    try:
        with np.errstate(invalid="ignore"):  # a NaN may be one that signals
            return SampledDisplacement(stored.grid, values * signs)
    except InputError as wrong:
        raise ImageFileError(f"{place}: {wrong}") from wrong


def rigid_from_elastix(parameters: Parameters) -> RigidMotion:
    """An EulerTransform without its initial one: x = R (X - c) + c + t; R = Rz Rx Ry, or Rz Ry Rx (ComputeZYX)."""
    _require(parameters, ("EulerTransform",))
    a, b, c, *shift = _numbers(parameters, "TransformParameters", 6)
    zyx = _word(parameters, "ComputeZYX", "false") == "true"
    rotation = Rotation.from_euler("ZYX", [c, b, a]) if zyx else Rotation.from_euler("ZXY", [c, a, b])
    return RigidMotion.about(_numbers(parameters, "CenterOfRotationPoint", 3), rotation.as_matrix(), np.array(shift))


def bspline_from_elastix(parameters: Parameters) -> BSpline:
    """Read an elastix B-spline from its parameter map alone (an initial transform is left out); NaN is let pass."""
    _require(parameters, ("BSplineTransform", "RecursiveBSplineTransform"))
    if _word(parameters, "BSplineTransformSplineOrder", "3") != "3":
        raise ParameterError("BSplineTransformSplineOrder is not 3; only cubic B-splines are supported.")
    if _word(parameters, "UseCyclicTransform", "false") == "true":
        raise ParameterError("UseCyclicTransform is true; cyclic B-splines are not supported.")
    size = _numbers(parameters, "GridSize", 3)
    if np.any((size != np.floor(size)) | (size < 1) | (size > _MOST_POINTS)):
        raise ParameterError(f"GridSize must be three whole numbers from 1 to {_MOST_POINTS}; it is {size.tolist()}.")
    shape = (int(size[0]), int(size[1]), int(size[2]))
    index = _numbers(parameters, "GridIndex", 3) if "GridIndex" in parameters else np.zeros(3)
    spacing, origin = _numbers(parameters, "GridSpacing", 3), _numbers(parameters, "GridOrigin", 3)
    direction = np.eye(3)
    if "GridDirection" in parameters:
        direction = _numbers(parameters, "GridDirection", 9).reshape(3, 3).T  # written column by column
    flat = _numbers(parameters, "TransformParameters", 3 * math.prod(shape))
    coefficients = np.stack([c.reshape(shape, order="F") for c in flat.reshape(3, -1)])
    try:
        control = Grid(shape, spacing, origin + direction @ (spacing * index), direction)
        return BSpline(control, coefficients)
    except InputError as wrong:
        raise ParameterError(f"The grid of the control points is not valid: {wrong}") from wrong


def _affine_from_elastix(parameters: Parameters) -> Affine:
    kind = _word(parameters, "Transform", "")
    if kind == "TranslationTransform":
        return Affine(np.eye(3), _numbers(parameters, "TransformParameters", 3))
    centre = _numbers(parameters, "CenterOfRotationPoint", 3)
    if kind == "AffineTransform":
        given = _numbers(parameters, "TransformParameters", 12)
        return Affine.about(centre, given[:9].reshape(3, 3), given[9:])
    given = _numbers(parameters, "TransformParameters", 7)  # SimilarityTransform: versor, translation, scale
    if not given[:3] @ given[:3] <= 1.0:
        raise ParameterError("TransformParameters do not begin with a versor: its three numbers are longer than 1.")
    versor = sitk.VersorTransform(tuple(float(v) for v in (*given[:3], np.sqrt(1.0 - given[:3] @ given[:3]))))
    return Affine.about(centre, given[6] * np.reshape(versor.GetMatrix(), (3, 3)), given[3:6])


_ELASTIX: dict[str, Callable[[Parameters], Deformation]] = {
    "EulerTransform": rigid_from_elastix,
    **dict.fromkeys(("BSplineTransform", "RecursiveBSplineTransform"), bspline_from_elastix),
    **dict.fromkeys(("AffineTransform", "SimilarityTransform", "TranslationTransform"), _affine_from_elastix),
}


def _read_elastix(path: Path, chain: tuple[Path, ...]) -> Deformation:
    if path.resolve() in chain:
        raise ParameterError(f"{path}: the chain of initial transforms leads back to this file.")
    try:
        parameters = parse_parameters(path.read_text(encoding="utf-8-sig"))
        last = _last_of_chain(path, parameters)
    except (OSError, UnicodeDecodeError) as failure:
        raise InputError(f"{path}: cannot be read as an elastix transform file ({failure}).") from failure
    except ParameterError as wrong:
        raise ParameterError(f"{path}: {wrong}") from wrong
    older = _word(parameters, "InitialTransformParametersFileName", _NO_INITIAL)
    name = _word(parameters, "InitialTransformParameterFileName", "") or older
    if name == _NO_INITIAL:
        return last
    initial = path.parent / name  # an absolute name stays what it is
    if not initial.is_file():
        raise InputError(
            f"{path}: the initial transform '{name}' is missing. Copy it to the same folder, and set "
            "InitialTransformParameterFileName to its file name without a path."
        )
    first = _read_elastix(initial, (*chain, path.resolve()))
    how = _word(parameters, "HowToCombineTransforms", "Compose")
    if how == "Compose":
        return Composed([*flat(first), last])
    if how != "Add":
        raise ParameterError(f"{path}: HowToCombineTransforms must be Compose or Add; it is '{how}'.")
    splines = [part for part in (first, last) if isinstance(part, BSpline)]
    if len(splines) == 2 and splines[0].control.same_as(splines[1].control, tolerance_voxels=_SAME_CONTROL):
        return splines[1].plus(splines[0])
    return Added((first, last))


def _last_of_chain(path: Path, parameters: Parameters) -> Deformation:
    kind = _word(parameters, "Transform", "")
    if kind == "File":
        named = path.parent / _word(parameters, "TransformFileName", "")
        if not named.is_file():
            raise InputError(
                f"{path}: the ITK transform file '{named.name}' (TransformFileName) is missing. Copy it there."
            )
        return read_itk_transform(named)
    _require(parameters, tuple(_ELASTIX))
    ignored = _word(parameters, "UseDirectionCosines", "true") == "false" and "Direction" in parameters
    if ignored and np.abs(_numbers(parameters, "Direction", 9) - np.eye(3).ravel()).max() > _SAME_CONTROL:
        raise ParameterError(
            "UseDirectionCosines is false, so this transform ignores the direction of the image and is not in LPS "
            'mm. Register again with (UseDirectionCosines "true").'
        )
    made = _ELASTIX[kind](parameters)
    if isinstance(made, BSpline) and not np.isfinite(made.coefficients_mm).all():
        raise ParameterError(
            "TransformParameters are not all finite: the registration diverged. Register again with smaller steps."
        )
    return made


def _require(parameters: Parameters, kinds: tuple[str, ...]) -> None:
    kind = _word(parameters, "Transform", "")
    if kind not in kinds:
        raise ParameterError(f'(Transform "{kind}") is not supported; supported: {", ".join(kinds)}.')
    for name in ("FixedImageDimension", "MovingImageDimension"):
        if _word(parameters, name, "3") != "3":
            raise ParameterError(f"{name} is {_word(parameters, name, '')}; a transform of 3D images is needed.")
    if _word(parameters, "UseBinaryFormatForTransformationParameters", "false") == "true":
        raise ParameterError("the parameters are in a separate binary file; let elastix write them as text.")


def _word(parameters: Parameters, name: str, default: str) -> str:
    values = parameters.get(name, ())
    return values[0] if values else default


def _numbers(parameters: Parameters, name: str, count: int) -> FloatArray:
    if name not in parameters:
        raise ParameterError(f"{name} is missing; {count} numbers are needed.")
    try:
        values = numbers(parameters[name])
    except ValueError as failure:
        raise ParameterError(f"{name} has a value that is not a number ({failure}).") from failure
    if len(values) != count:
        raise ParameterError(f"{name} has {len(values)} numbers; {count} are needed.")
    if name != "TransformParameters" and not np.isfinite(values).all():  # in these a registration may have diverged
        raise ParameterError(f"{name} has numbers that are not finite.")
    return values


def _frame_beside(path: Path) -> str | None:
    stem = path.name.removesuffix(".gz").rsplit(".", maxsplit=1)[0]
    beside = path.with_name(stem + ".json")
    if not beside.is_file():
        return None
    try:
        header = read_json(beside)
        frame, unit = header.get("frame"), header.get("unit", "mm")
    except (OSError, ValueError) as failure:
        raise ImageFileError(f"{beside}: cannot be read as a JSON object ({failure}).") from failure
    if unit != "mm" or header.get("configuration", "reference") != "reference":
        raise ImageFileError(f"{beside}: a displacement in mm in the reference configuration is needed; got {header}.")
    return None if frame is None else str(frame)


def _frame_of_header(place: Path) -> str | None:
    """Frame of the components, where the format fixes it."""
    name = place.name.lower()
    if name.endswith((".mha", ".mhd")):
        return "LPS"
    if not name.endswith((".nrrd", ".nhdr")):
        return None
    fields = nrrd_fields(place)[0]
    in_lps = fields.get("space", "").lower() in ("left-posterior-superior", "lps")
    return "LPS" if in_lps and "measurement frame" not in fields else None
