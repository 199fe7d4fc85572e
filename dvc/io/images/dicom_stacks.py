"""Stacks of DICOM frames: frames put together by what they show and by their position, never by their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.errors import InputError
from dvc.io.images.dicom_enhanced import STACK, TIME_POINT
from dvc.io.images.dicom_frames import Frame, Labels

SAME_PLACE_MM = 0.01
_SAME_DIRECTION = 1e-3
_LISTED = 40
_SEVERAL = "several echoes, image types, orientations, stacks or time points"


@dataclass(frozen=True, slots=True, eq=False)
class Stack:
    """Frames of one image; `labels` distinguish it from others of the same kind and orientation."""

    frames: list[Frame]
    labels: Labels = ()

    @property
    def series(self) -> str:
        """UID of the series."""
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


def stacks_of(frames: Sequence[Frame]) -> list[Stack]:
    """Group frames by kind and orientation, and then by whatever else distinguishes volumes."""
    stacks: list[Stack] = []
    values: dict[str, set[str | int]] = {}
    for one in frames:
        for stack in stacks:
            first = stack.frames[0]
            if first.kind == one.kind and np.abs(first.axes - one.axes).max() < _SAME_DIRECTION:
                stack.frames.append(one)
                break
        else:
            stacks.append(Stack([one]))
        for name, value in one.labels:
            values.setdefault(name, set()).add(value)
    # By stack and time point, then by the labels with the fewest values, so that few parts result.
    for name in sorted(values, key=lambda name: (name != STACK, name != TIME_POINT, len(values[name]))):
        stacks = [part for stack in stacks for part in _parted(stack, name)]
    return stacks


def _parted(stack: Stack, name: str) -> list[Stack]:
    """Part a stack by a label in which frames at one place differ; named stacks wherever they lie.

    Scanners count along other dimensions than they say, or call each slice a stack; a label that follows the position
    alone does not distinguish volumes.
    """
    parts: dict[str | int | None, list[Frame]] = {}
    for one in stack.frames:
        parts.setdefault(dict(one.labels).get(name), []).append(one)
    if len(parts) == 1:
        return [stack]
    apart = name == STACK and max(len(p) for p in parts.values()) > 1
    if not apart:
        normal = np.cross(*stack.frames[0].axes)
        along = np.array([one.position_mm @ normal for part in parts.values() for one in part])
        part_of = np.repeat(np.arange(len(parts)), [len(p) for p in parts.values()])
        order = np.argsort(along)
        place_of = np.cumsum(np.diff(along[order], prepend=along[order[0]]) > SAME_PLACE_MM)
        pairs = np.unique(np.stack([place_of, part_of[order]]), axis=1)
        apart = pairs.shape[1] > int(place_of[-1]) + 1
    if not apart:
        return [stack]
    return [
        Stack(part, stack.labels if value is None else (*stack.labels, (name, value))) for value, part in parts.items()
    ]


def named_stacks(stacks: Sequence[Stack]) -> dict[str, Stack]:
    """Name stacks by the shortest distinct end of their series UID, numbered within a series."""
    uids = sorted({stack.series for stack in stacks})
    digits = 6
    while len({uid[-digits:] for uid in uids}) < len(uids):
        digits += 1
    named = {}
    for uid in uids:
        own = sorted((s for s in stacks if s.series == uid), key=Stack.order)
        for number, stack in enumerate(own, start=1):
            named[uid[-digits:] + (f"/{number}" if len(own) > 1 else "")] = stack
    return named


def pick_stack(place: Path, stacks: dict[str, Stack], series: str | None) -> Stack:
    """Return the only stack, or the one whose name or series UID ends as `series` does; otherwise list them all."""
    wanted, _, number = (series or "").strip().rpartition("/") if "/" in (series or "") else (series or "", "", "")
    matching = [
        stack
        for name, stack in stacks.items()
        if stack.series.endswith(wanted) and (not number or name.endswith(f"/{number}"))
    ]
    if len(matching) == 1:
        return matching[0]
    lines = [f"  {name}: {stack.describe()}" for name, stack in stacks.items()]
    if len(lines) > _LISTED:
        lines[_LISTED:] = [f"  and {len(lines) - _LISTED} more, named in the same way"]
    what = "folder" if place.is_dir() else "file"
    if series is None:
        uids = {stack.series for stack in stacks.values()}
        held = f"{len(uids)} DICOM series" if len(uids) > 1 else _SEVERAL
        problem = f"the {what} holds {held}; one is needed"
    else:
        problem = f"series='{series}' fits {len(matching)} of the DICOM series in this {what}"
    move = "Move the files of one into a folder of its own, or write it" if place.is_dir() else "Write one"
    raise InputError(
        f"{place}: {problem}. {move} to a file: in Python, "
        f'dvc.write_image("one.nii.gz", dvc.read_image("{place}", series=NAME)) with a NAME out of this list:\n'
        + "\n".join(lines)
    )
