"""DICOM images: slices or frames put together by their position in space, never by their numbers.

A classic series is a folder with a file for each slice; enhanced (multi-frame) files hold many slices each. Both give
frames (`dvc.io.images.dicom_frames`), and all that follows is the same for both.
"""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dvc.arrays import Float32Array
from dvc.errors import ImageFileError
from dvc.images.image import Grid
from dvc.io.images.dicom_enhanced import enhanced_frames, is_enhanced
from dvc.io.images.dicom_frames import CONVERT, Frame, classic_frame, damage_named, read_image_header
from dvc.io.images.dicom_pixels import read_values
from dvc.io.images.dicom_stacks import SAME_PLACE_MM, named_stacks, pick_stack, stacks_of
from dvc.io.images.stored import MAX_BYTES, refuse_if_too_large

_log = logging.getLogger("dvc.images")

_SUFFIXES = (".dcm", ".ima")
_OFF_PLACE = 0.1  # of a voxel


def is_dicom(path: Path) -> bool:
    """Whether a file looks like DICOM, from its first bytes or its suffix."""
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM" or path.suffix.lower() in _SUFFIXES


def is_multiframe(path: Path) -> bool:
    """Whether a file is a DICOM image of several frames."""
    if not is_dicom(path):
        return False
    try:
        header = _header(path)
        return header is not None and len(_frames(path, header)) > 1
    except ImageFileError:  # none that could be used
        return False


def read_dicom(place: Path, *, series: str | None = None, max_bytes: int = MAX_BYTES) -> tuple[Grid, Float32Array]:
    """Grid (LPS mm) and values (columns, rows, slices) of a DICOM folder (without subfolders) or of one enhanced file.

    Slices are ordered along the normal of their plane; rescale slope and intercept of each are applied. Private
    scalings, such as Philips' scale slope, are not. `series` is the end of a series' UID, and "/n" for the n-th stack
    of a series with several echoes, image types, orientations, stacks or time points, as the refusal lists them.
    """
    grid, ordered = _found(place, series)
    refuse_if_too_large(place, grid.shape, max_bytes)
    return grid, read_values(ordered).transpose(2, 1, 0)


def _found(place: Path, series: str | None) -> tuple[Grid, list[Frame]]:
    """Find the grid of the one image that is there or picked, and its frames in order."""
    stacks = named_stacks(stacks_of(_frames_in(place) if place.is_dir() else _frames_of_one(place)))
    if not stacks:
        raise ImageFileError(f"{place}: no DICOM image in this folder (subfolders are not searched).")
    return _assembled(place, pick_stack(place, stacks, series).frames)


def _frames_in(folder: Path) -> list[Frame]:
    frames, parts, skipped = [], [], 0
    for path in sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")):
        header = _header(path) if is_dicom(path) else None
        if header is None:
            skipped += 1
            continue
        frames += _frames(path, header)
        parts += _concatenation(path, header)
    for (_, total), held in Counter(parts).items():
        if held != total:
            raise ImageFileError(
                f"{folder}: an image that was stored in {total} files, of which {held} are here. Export the "
                "whole series."
            )
    if skipped and frames:
        _log.info("%s: %d files that are no DICOM images left out", folder, skipped)
    return frames


def _frames_of_one(path: Path) -> list[Frame]:
    header = _header(path)
    if header is None:
        raise ImageFileError(f"{path}: a DICOM file without an image, such as a report. Give the image.")
    frames = _frames(path, header)
    if len(frames) == 1 or any(total > 1 for _, total in _concatenation(path, header)):
        raise ImageFileError(f"{path}: one file of a DICOM series. Give its folder instead: {path.parent}")
    return frames


def _concatenation(path: Path, header: Any) -> list[tuple[str, int]]:
    """UID and number of files of the image that a file is a part of; nothing where it is the whole."""
    with damage_named(path):
        uid, total = header.get("ConcatenationUID"), header.get("InConcatenationTotalNumber")
        return [(str(uid), int(total))] if uid and total else []


def _header(path: Path) -> Any | None:
    with damage_named(path):
        return read_image_header(path)


def _frames(path: Path, header: Any) -> list[Frame]:
    with damage_named(path):
        return enhanced_frames(path, header) if is_enhanced(header) else [classic_frame(path, header)]


def _assembled(place: Path, stack: list[Frame]) -> tuple[Grid, list[Frame]]:
    """Grid of a stack of parallel slices [1]_, and the slices in its order.

    .. [1] DICOM PS3.3, Image Plane Module (C.7.6.2):
    https://dicom.nema.org/medical/dicom/current/output/html/part03.html
    """
    x = stack[0].axes[0] / np.linalg.norm(stack[0].axes[0])
    normal = np.cross(x, stack[0].axes[1])
    normal /= np.linalg.norm(normal)
    ordered = sorted(stack, key=lambda s: float(s.position_mm @ normal))
    positions = np.array([s.position_mm for s in ordered])
    along = positions @ normal
    if len(ordered) < 2:
        raise ImageFileError(f"{place}: a single slice ({ordered[0].name}); a volume is needed.")
    steps = np.diff(along)
    twice = np.flatnonzero(steps < SAME_PLACE_MM)
    if len(twice):
        pairs = "; ".join(f"{ordered[t].name} and {ordered[t + 1].name}" for t in twice[:3])
        if any(ordered[t].number is not None and ordered[t].path == ordered[t + 1].path for t in twice):
            cause = f"The file holds several volumes and does not say which frame belongs to which. {CONVERT}"
        else:
            cause = "Two acquisitions or copies are mixed: keep one of each."
        raise ImageFileError(f"{place}: {len(twice)} slices lie where another one does ({pairs}). {cause}")
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > 1.5 * usual)
    if len(gaps):
        first = gaps[0]
        raise ImageFileError(
            f"{place}: slices are missing: {len(gaps)} gaps in a stack with a slice every {usual:.4g} mm; "
            f"the first, of {steps[first]:.4g} mm, between {ordered[first].name} and "
            f"{ordered[first + 1].name}. Export the whole series."
        )
    spacing = float(along[-1] - along[0]) / (len(ordered) - 1)
    uneven = float(np.abs(along - along[0] - spacing * np.arange(len(ordered))).max())
    aside = float(np.linalg.norm(positions - positions[0] - np.outer(along - along[0], normal), axis=1).max())
    column_spacing, row_spacing = stack[0].spacing_mm
    if uneven > _OFF_PLACE * spacing or aside > _OFF_PLACE * min(column_spacing, row_spacing):
        raise ImageFileError(
            f"{place}: the slices are not evenly stacked: up to {uneven:.3g} mm off an even spacing of {spacing:.4g} "
            f"mm, and up to {aside:.3g} mm sideways (tilted gantry). Resample the series to a regular grid first."
        )
    direction = np.stack([x, np.cross(normal, x), normal], axis=1)
    sizes = np.array([column_spacing, row_spacing, spacing])
    return Grid((stack[0].kind.columns, stack[0].kind.rows, len(ordered)), sizes, positions[0], direction), ordered
