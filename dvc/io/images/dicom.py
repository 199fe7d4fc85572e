"""DICOM images, a file for each slice or enhanced (multi-frame): slices stacked by their position, never by number."""

import logging
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from dvc.arrays import Float32Array
from dvc.errors import ImageFileError, InputError
from dvc.images.image import Grid
from dvc.io.images.dicom_frames import CONVERT, STACK, TIME_POINT, Frame, Labels, read_frames, read_values
from dvc.io.images.stored import MAX_BYTES, refuse_if_too_large

_log = logging.getLogger("dvc.images")

_OFF_PLACE = 0.1  # of a voxel
_SAME_PLACE_MM = 0.01
_SAME_DIRECTION = 1e-3
_LISTED = 40
_SEVERAL = "several echoes, image types, orientations, stacks or time points"


def is_dicom(path: Path) -> bool:
    """Whether a file looks like DICOM, from its first bytes or its suffix."""
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM" or path.suffix.lower() in (".dcm", ".ima")


def is_multiframe(path: Path) -> bool:
    """Whether a file is a DICOM image of several frames."""
    with suppress(ImageFileError):  # none that could be used
        frames, _ = read_frames(path) if is_dicom(path) else ([], None)
        return len(frames) > 1
    return False


def read_dicom(place: Path, *, series: str | None = None, max_bytes: int = MAX_BYTES) -> tuple[Grid, Float32Array]:
    """Grid (LPS mm) and values (columns, rows, slices) of a DICOM folder (without subfolders) or of one enhanced file.

    Slices are ordered along the normal of their plane; rescale slope and intercept of each are applied. Private
    scalings, such as Philips' scale slope, are not. `series` is the end of a series' UID, and "/n" for the n-th stack
    of a series with several echoes, image types, orientations, stacks or time points, as the refusal lists them.
    """
    frames = _frames_in(place) if place.is_dir() else _frames_of_one(place)
    stacks = _named_stacks(_stacks_of(frames))
    if not stacks:
        raise ImageFileError(
            f"{place}: no DICOM images in this folder (subfolders are not searched). Give the folder that holds "
            "them, or an image file."
        )
    grid, ordered = _assembled(place, _pick_stack(place, stacks, series).frames)
    refuse_if_too_large(place, grid.shape, max_bytes)
    return grid, read_values(ordered).transpose(2, 1, 0)


def _frames_in(folder: Path) -> list[Frame]:
    paths = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    contents = [read_frames(path) for path in paths if is_dicom(path)]
    for (_, total), held in Counter(part for _, part in contents if part).items():
        if held != total:
            stored = f"the image is stored in {total} files, but only {held} are in this folder"
            raise ImageFileError(f"{folder}: {stored}. Export the whole series.")
    frames = [frame for own, _ in contents for frame in own]
    skipped = len(paths) - sum(bool(own) for own, _ in contents)
    if skipped and frames:
        _log.info("%s: %d files are not DICOM images and were skipped", folder, skipped)
    return frames


def _frames_of_one(path: Path) -> list[Frame]:
    frames, part = read_frames(path)
    if not frames:
        raise ImageFileError(f"{path}: this DICOM file has no image; it may be a report. Pass the image.")
    if len(frames) == 1 or (part and part[1] > 1):
        raise ImageFileError(f"{path}: this is one file of a DICOM series. Pass its folder instead: {path.parent}")
    return frames


def _assembled(place: Path, stack: list[Frame]) -> tuple[Grid, list[Frame]]:
    """Grid of a stack of parallel slices (DICOM PS3.3, C.7.6.2), and the slices in its order."""
    x = stack[0].axes[0] / np.linalg.norm(stack[0].axes[0])
    normal = np.cross(x, stack[0].axes[1])
    normal /= np.linalg.norm(normal)
    ordered = sorted(stack, key=lambda s: float(s.position_mm @ normal))
    positions = np.array([s.position_mm for s in ordered])
    along = positions @ normal
    if len(ordered) < 2:
        raise ImageFileError(f"{place}: the image is a single slice ({ordered[0].name}); a volume is needed.")
    steps = np.diff(along)
    twice = np.flatnonzero(steps < _SAME_PLACE_MM)
    if len(twice):
        pairs = "; ".join(f"{ordered[t].name} and {ordered[t + 1].name}" for t in twice[:3])
        if any(ordered[t].number is not None and ordered[t].path == ordered[t + 1].path for t in twice):
            cause = f"The file has several volumes, but does not state the volume of each frame. {CONVERT}"
        else:
            cause = "Two acquisitions or copies are mixed; keep only one."
        raise ImageFileError(f"{place}: {len(twice)} slices have the position of another slice ({pairs}). {cause}")
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > 1.5 * usual)
    if len(gaps):
        first, before, after = steps[gaps[0]], ordered[gaps[0]].name, ordered[gaps[0] + 1].name
        raise ImageFileError(
            f"{place}: slices are missing. The stack has {len(gaps)} gaps at a slice spacing of {usual:.4g} mm; the "
            f"first, of {first:.4g} mm, is between {before} and {after}. Export the whole series."
        )
    spacing = float(along[-1] - along[0]) / (len(ordered) - 1)
    uneven = float(np.abs(along - along[0] - spacing * np.arange(len(ordered))).max())
    aside = float(np.linalg.norm(positions - positions[0] - np.outer(along - along[0], normal), axis=1).max())
    column_spacing, row_spacing = stack[0].spacing_mm
    if uneven > _OFF_PLACE * spacing or aside > _OFF_PLACE * min(column_spacing, row_spacing):
        raise ImageFileError(
            f"{place}: the slices are not evenly stacked. They deviate by up to {uneven:.3g} mm from an even spacing "
            f"of {spacing:.4g} mm, and by up to {aside:.3g} mm sideways (tilted gantry). Resample the series to a "
            "regular grid first."
        )
    direction = np.stack([x, np.cross(normal, x), normal], axis=1)
    sizes = np.array([column_spacing, row_spacing, spacing])
    return Grid((stack[0].kind.columns, stack[0].kind.rows, len(ordered)), sizes, positions[0], direction), ordered


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """Frames of one image; `labels` distinguish it from others of the same kind and orientation."""

    frames: list[Frame]
    labels: Labels = ()

    @property
    def series(self) -> str:
        return self.frames[0].kind.series

    def describe(self) -> str:
        """Size, echo, image type, labels and direction, for a person to choose by."""
        kind = self.frames[0].kind
        normal = np.cross(*self.frames[0].axes)
        parts = [f"{len(self.frames)} slices of {kind.columns} x {kind.rows}"]
        parts += [f"echo time {kind.echo_time_ms:g} ms"] if kind.echo_time_ms is not None else []
        parts += [f"echo {'/'.join(kind.echo)}"] if kind.echo else []
        parts += [f"image type {kind.image_type}"] if kind.image_type else []
        # The name of a stack is free text, which nobody vouches for.
        parts += [f"{name} {value if str(value).isdigit() else 'with a name'}" for name, value in self.labels]
        parts += [f"voxels of {kind.column_spacing_mm:g} x {kind.row_spacing_mm:g} mm"]
        parts += ["stacked along ({})".format(", ".join(f"{v:.2f}" for v in normal + 0.0))]
        return ", ".join(parts)

    def order(self) -> tuple[str, list[list[float]], list[tuple[int, str]]]:
        """By echo, image type, direction and labels, so that numbers do not depend on the files' names."""
        first = self.frames[0]
        labels = [(int(v) if str(v).isdigit() else -1, str(v)) for _, v in self.labels]
        return str(first.kind[1:]), first.axes.round(2).tolist(), labels


def _stacks_of(frames: Sequence[Frame]) -> list[_Stack]:
    """Group frames by kind and orientation, and then by whatever else distinguishes volumes."""
    stacks: list[_Stack] = []
    values: dict[str, set[str | int]] = {}
    for one in frames:
        for stack in stacks:
            first = stack.frames[0]
            if first.kind == one.kind and np.abs(first.axes - one.axes).max() < _SAME_DIRECTION:
                stack.frames.append(one)
                break
        else:
            stacks.append(_Stack([one]))
        for name, value in one.labels:
            values.setdefault(name, set()).add(value)
    # By stack and time point, then by the labels with the fewest values, so that few parts result.
    for name in sorted(values, key=lambda name: (name != STACK, name != TIME_POINT, len(values[name]))):
        stacks = [part for stack in stacks for part in _parted(stack, name)]
    return stacks


def _parted(stack: _Stack, name: str) -> list[_Stack]:
    """Part a stack by a label in which frames at one place differ; named stacks wherever they lie.

    Scanners count along other dimensions than they say, or call each slice a stack; a label that follows the position
    alone does not distinguish volumes.
    """
    of_frame = [dict(one.labels).get(name) for one in stack.frames]
    parts: dict[str | int | None, list[Frame]] = {}
    for one, label in zip(stack.frames, of_frame, strict=True):
        parts.setdefault(label, []).append(one)
    if len(parts) == 1:
        return [stack]
    if name != STACK or max(len(part) for part in parts.values()) == 1:
        along = np.array([one.position_mm for one in stack.frames]) @ np.cross(*stack.frames[0].axes)
        order = np.argsort(along)
        place = np.cumsum(np.diff(along[order], prepend=along[order[0]]) > _SAME_PLACE_MM).tolist()
        if len({(at, of_frame[k]) for at, k in zip(place, order, strict=True)}) == place[-1] + 1:
            return [stack]
    return [_Stack(part, stack.labels if v is None else (*stack.labels, (name, v))) for v, part in parts.items()]


def _named_stacks(stacks: Sequence[_Stack]) -> dict[str, _Stack]:
    """Name stacks by the shortest distinct end of their series UID, numbered within a series."""
    uids = sorted({stack.series for stack in stacks})
    digits = next(n for n in count(6) if len({uid[-n:] for uid in uids}) == len(uids))
    named = {}
    for uid in uids:
        own = sorted((s for s in stacks if s.series == uid), key=_Stack.order)
        for number, stack in enumerate(own, start=1):
            named[uid[-digits:] + (f"/{number}" if len(own) > 1 else "")] = stack
    return named


def _pick_stack(place: Path, stacks: dict[str, _Stack], series: str | None) -> _Stack:
    """Return the only stack, or the one whose name or series UID ends as `series` does; otherwise list them all."""
    wanted, _, number = (series or "").strip().partition("/")
    ending = f"/{number}" if number else ""
    matching = [s for name, s in stacks.items() if s.series.endswith(wanted) and name.endswith(ending)]
    if len(matching) == 1:
        return matching[0]
    lines = [f"  {name}: {stack.describe()}" for name, stack in stacks.items()]
    if len(lines) > _LISTED:
        lines[_LISTED:] = [f"  and {len(lines) - _LISTED} more, named in the same way"]
    what, move = "file", "Convert it"
    if place.is_dir():
        what, move = "folder", "Move one image to its own folder, or convert all"
    problem = f"series='{series}' matches {len(matching)} of the DICOM series in this {what}"
    if series is None:
        several = len({stack.series for stack in stacks.values()})
        problem = f"this {what} contains {f'{several} DICOM series' if several > 1 else _SEVERAL}; one image is needed"
    raise InputError(
        f"{place}: {problem}. {move} (dcm2niix) and pass one .nii.gz file. In Python: "
        f'dvc.write_image("one.nii.gz", dvc.read_image("{place}", series=NAME)), with NAME one of:\n' + "\n".join(lines)
    )
