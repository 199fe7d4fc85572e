"""Masks and label maps: reading them, their names, and bringing them onto an image's grid."""

import logging
import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from dvc.arguments import checked
from dvc.arrays import IntArray
from dvc.errors import GeometryError, InputError, few
from dvc.images.image import Grid, LabelMap, Mask
from dvc.io import StrPath
from dvc.io.images.read import read_voxels
from dvc.io.images.text_headers import nrrd_fields
from dvc.mesh import box_told
from dvc.tables import read_table, read_text, refuse_half_a_line

_log = logging.getLogger("dvc.images")

_COUNTED = 1 << 16
_LARGEST_LABEL = 2**31
_NEEDED_OVERLAP = 0.5
_POINTS_AT_ONCE = 1 << 20
_LABEL_COLUMNS = ("label", "value", "index", "id")
_LABEL = "[0-9]{1,18}"
_NAME_COLUMNS = ("name", "structure", "label")  # "label" may head the names beside another column of numbers

_OnGrid = TypeVar("_OnGrid", Mask, LabelMap)


@checked
def read_mask(path: StrPath, grid: Grid | None = None) -> Mask:
    """Read a mask: a file of zeros and one other value (0/1, 0/255, ...).

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd, .nhdr, .mha or .mhd
    grid : Grid, optional
        The image's grid, onto which the mask is brought by `fit_mask`.

    Raises
    ------
    ImageFileError
        If the file cannot be read, as in `read_image`.
    InputError
        If the mask is empty, or holds several values other than zero; the message lists them.
    GeometryError
        If it does not lie on ``grid``.
    """
    place = Path(path)
    own, labels, counts = _integers(place, "mask")
    if len(counts) > 1:
        names = _segment_names(place)
        listed = [f"{v}" + (f" ({names[v]})" if v in names else "") + f": {n} voxels" for v, n in counts.items()]
        raise InputError(
            f"{place}: a mask must have zeros and one other value, but this file has {len(counts)}: "
            f"{few(listed, most=3)}. It is a label map: use --labels and --bone-label, or save one region as a mask."
        )
    mask = Mask(own, labels != 0)
    return mask if grid is None else fit_mask(mask, grid, f"{place}")


@checked
def read_labels(path: StrPath, names: StrPath | Mapping[int, str] | None = None) -> LabelMap:
    """Read a label map and the names of its regions.

    Parameters
    ----------
    path : .nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd, or Slicer's .seg.nrrd, which has its own names
    names : mapping, or file of names (CSV, ITK-SNAP label descriptions, Slicer colour table), optional
        Without names label N is called "label-N". Names of labels that the map does not hold are ignored.

    Raises
    ------
    ImageFileError
        If a file cannot be read, as in `read_image`.
    InputError
        If the map is empty, a value is negative or not a whole number, or a label has no name.
    """
    place = Path(path)
    grid, labels, present = _integers(place, "label map")
    if min(present) < 0:
        raise InputError(f"{place}: labels must not be negative; found {few(v for v in present if v < 0)}.")
    known = read_names(names) if isinstance(names, str | PathLike) else names
    if known is None:
        known = _segment_names(place) or {v: f"label-{v}" for v in present}
    nameless = [v for v in present if v not in known]
    if nameless:
        source = f" in {names}" if isinstance(names, str | PathLike) else ""
        lack = f"labels without a name{source}: {few(nameless, most=4)}"
        raise InputError(f"{place}: {lack}. Names are given for {few(sorted(known), most=4)}; add the missing ones.")
    return LabelMap(grid, labels, {v: known[v] for v in present})


def read_names(path: StrPath) -> dict[int, str]:
    """Names of labels from a table: CSV, ITK-SNAP's label descriptions, or a Slicer colour table.

    CSV needs a header line with a column of labels (label, value, index or id) and one of names (name, label or
    structure). ITK-SNAP: ``index r g b a visible mesh "name"``. Slicer: ``index name r g b a``. Label 0 has no name.
    """
    place = Path(path)
    if is_csv := place.suffix.lower() == ".csv":
        lines, rows = [], _csv_names(*read_table(place))
    else:
        stripped = (line.strip() for line in read_text(place).splitlines())
        lines = [line for line in stripped if line and not line.startswith("#")]
        rows = [_table_name(line) for line in lines]
    if not rows or None in rows:
        wrong = "" if is_csv or not rows else f" (line: {lines[rows.index(None)][:60]!r})"
        raise InputError(
            f"{place}: not a table of labels and names{wrong}. Supported: CSV with a header line 'label,name', "
            "ITK-SNAP label descriptions, Slicer colour tables."
        )
    if not is_csv:
        refuse_half_a_line(place)
    names: dict[int, str] = {}
    for value, name in filter(None, rows):
        if value in names:
            raise InputError(f"{place}: label {value} has two names, '{names[value]}' and '{name}'. Keep one.")
        if value != 0:
            names[value] = name
    return names


@checked
def fit_mask(mask_or_labels: _OnGrid, grid: Grid, what: str = "mask") -> _OnGrid:
    """Bring a mask or label map onto an image's grid.

    On the same grid, up to the last digits of a header, it takes the image's geometry. On another grid of the same
    frame (cropped, coarser, finer, oblique) every voxel of the image takes the nearest value, and a warning is logged.

    Parameters
    ----------
    mask_or_labels : Mask or LabelMap
        On any grid, LPS mm.
    grid : Grid
        The image's grid.
    what : its name in messages, such as its path

    Raises
    ------
    InputError
        If an argument is of another kind.
    GeometryError
        If less than half of its volume lies in the image, if it is the image's grid mirrored (RAS taken for
        LPS), or if nothing of it is left on the grid.

    Examples
    --------
    >>> coarse = Mask(Grid((2, 2, 2), (2.0, 2.0, 2.0), (0.5, 0.5, 0.5)), np.ones((2, 2, 2), dtype=bool))
    >>> fitted = fit_mask(coarse, Grid((5, 5, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)))
    >>> int(fitted.inside.sum()), coarse.volume_mm3
    (64, 64.0)
    """
    own = mask_or_labels.grid
    field = "inside" if isinstance(mask_or_labels, Mask) else "labels"
    values: npt.NDArray[Any] = getattr(mask_or_labels, field)
    if own.same_as(grid):
        return replace(mask_or_labels, grid=grid)
    filled, inside = np.flatnonzero(values), 0  # voxels other than 0, and how many centres lie in the image's box
    total = len(filled)
    for start in range(0, total, _POINTS_AT_ONCE):
        indices = np.stack(np.unravel_index(filled[start : start + _POINTS_AT_ONCE], own.shape), axis=-1)
        inside += int(np.count_nonzero(grid.contains(own.points_at(indices.astype(np.float64)))))
    if total == 0:
        raise GeometryError(f"{what}: all voxels are 0. Choose another file.")
    share = inside / total
    boxes = f"It spans {box_told(*own.bounds_mm())} mm; the image {box_told(*grid.bounds_mm())} mm (LPS)."
    if share < _NEEDED_OVERLAP:
        raise GeometryError(
            f"{what}: only {100 * share:.0f} % of its volume is inside the image; at least "
            f"{100 * _NEEDED_OVERLAP:.0f} % is needed. {boxes} It was drawn on another image, or its header is wrong."
        )
    mirrored = _mirrored_axes(own, grid)
    if mirrored:
        raise GeometryError(
            f"{what}: its grid equals that of the image with {mirrored} negated: RAS and LPS coordinates were mixed "
            f"up. {boxes} Export it again with the image loaded."
        )
    fitted: Any = _nearest(own, values, grid)
    left = np.count_nonzero(fitted) * grid.voxel_volume_mm3
    if left == 0:
        resampled = "no voxel is left after resampling to the grid of the image"
        raise GeometryError(f"{what}: {resampled}. {boxes} Export it again from its image.")
    before = total * own.voxel_volume_mm3
    change = f"{before / 1000:.4g} mL became {left / 1000:.4g} mL; {100 * share:.0f} % of it is inside the image"
    grids = f"Its grid: {own}. The image's grid: {grid}."
    _log.warning("%s: on another grid than the image; resampled by nearest neighbour (%s). %s", what, change, grids)
    if isinstance(mask_or_labels, LabelMap):
        lost = sorted(set(_counts(values)) - set(_counts(fitted)))
        if lost:
            _log.warning("%s: regions lost by resampling: %s", what, [mask_or_labels.names[v] for v in lost])
    return replace(mask_or_labels, grid=grid, **{field: fitted})


def _mirrored_axes(own: Grid, grid: Grid) -> str:
    """Name the world axes whose sign turns one grid into the other, or nothing."""
    wanted = grid.toward_lps()
    signs_of_ras = (-1.0, -1.0, 1.0)  # before the others: an image may be its own mirror image along an axis
    for signs in ((1.0, 1.0, 1.0), signs_of_ras, *product((1.0, -1.0), repeat=3)):
        flip = np.array(signs)
        mirror = Grid(own.shape, own.spacing_mm, own.origin_mm * flip, own.direction * flip[:, None])
        if mirror.toward_lps().same_as(wanted):
            return " and ".join(axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0)
    return ""


def _nearest(own: Grid, values: npt.NDArray[Any], grid: Grid) -> npt.NDArray[Any]:
    """Values of ``own`` at the voxel centres of ``grid``; 0 outside."""
    step = (np.linalg.inv(own.direction) @ grid.direction) * grid.spacing_mm / own.spacing_mm[:, None]
    start = own.indices_of(grid.origin_mm)
    j, k = np.ogrid[: grid.shape[1], : grid.shape[2]]
    fitted = np.zeros(grid.shape, dtype=values.dtype)
    for i in range(grid.shape[0]):  # a slice at a time: a whole grid of indices would be large
        index, within = [], np.ones(grid.shape[1:], dtype=bool)
        for axis in range(3):
            place = start[axis] + step[axis, 0] * i + step[axis, 1] * j + step[axis, 2] * k
            # The small shift settles ties, which rounding errors would otherwise scatter.
            whole = np.floor(place + (0.5 + 1e-9)).astype(np.intp)
            within &= (whole >= 0) & (whole < own.shape[axis])
            index.append(np.clip(whole, 0, own.shape[axis] - 1))
        fitted[i] = np.where(within, values[tuple(index)], 0)
    return fitted


def _integers(path: Path, what: str) -> tuple[Grid, IntArray, dict[int, int]]:
    """Grid, labels and their counts of a file whose values must be whole numbers, in whatever type they are stored."""
    if path.is_dir():
        problem = "a mask or label map must be one file, not a folder of DICOM files"
        raise InputError(f"{path}: {problem}. Convert it, for example to NIfTI.")
    grid, voxels = read_voxels(path)
    rule = f"{path}: masks and labels must be whole numbers below {_LARGEST_LABEL};"
    if voxels.dtype.kind == "f":
        whole = np.isfinite(voxels) & (np.abs(voxels) < _LARGEST_LABEL)
        whole &= np.rint(np.where(whole, voxels, 0)) == voxels
        if not whole.all():
            odd = [f"{v:g}" for v in np.unique(voxels[~whole])]
            raise InputError(
                f"{rule} {int((~whole).sum())} voxels are not ({few(odd, most=3)}). Threshold probability maps "
                "first, and resample labels only by nearest neighbour."
            )
    elif int(voxels.max()) >= _LARGEST_LABEL:
        raise InputError(f"{rule} the highest is {int(voxels.max())}. Renumber the labels.")
    labels = np.ascontiguousarray(voxels, dtype=np.int64)
    if not (counts := _counts(labels)):
        raise InputError(f"{path}: the {what} is empty; all {labels.size} voxels are 0. Choose another file.")
    return grid, labels, counts


def _counts(labels: npt.NDArray[Any]) -> dict[int, int]:
    """Labels other than 0 and their voxels."""
    if labels.dtype == bool or (labels.min() >= 0 and labels.max() < _COUNTED):  # many times faster
        counts = np.bincount(labels.ravel())
        values = np.flatnonzero(counts)
        counts = counts[values]
    else:
        values, counts = np.unique(labels, return_counts=True)
    return {int(v): int(n) for v, n in zip(values, counts, strict=True) if v != 0}


def _segment_names(path: Path) -> dict[int, str]:
    """Names that Slicer writes into a .seg.nrrd."""
    if not path.name.lower().endswith((".nrrd", ".nhdr")):
        return {}
    _, pairs, _ = nrrd_fields(path)
    return {
        int(value): pairs.get(f"Segment{segment[1]}_Name", f"label-{value.strip()}").strip()
        for key, value in pairs.items()
        if (segment := re.fullmatch(r"Segment(\d+)_LabelValue", key)) and re.fullmatch(_LABEL, value.strip())
    }


def _csv_names(columns: list[str], rows: list[tuple[int, list[str]]]) -> list[tuple[int, str] | None]:
    """Labels and names of a table; none if a column is missing, None for a row without a label."""
    name = next((columns.index(c) for c in _NAME_COLUMNS if c in columns), None)
    label = next((columns.index(c) for c in _LABEL_COLUMNS if c in columns and columns.index(c) != name), None)
    if name is None or label is None:
        return []
    return [(int(row[label]), row[name]) if re.fullmatch(_LABEL, row[label]) else None for _, row in rows]


def _table_name(line: str) -> tuple[int, str] | None:
    match = re.fullmatch(rf'({_LABEL})(?:\s+[\d.]+){{6}}\s+"(.*)"', line)  # ITK-SNAP
    match = match or re.fullmatch(rf"({_LABEL})\s+(\S.*?)(?:\s+[\d.]+){{4}}", line)  # Slicer
    return (int(match[1]), match[2].strip()) if match else None
