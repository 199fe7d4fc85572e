"""The loads of one subject side by side: the first figure of a report on measurements alone."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvc.io.result_folder import MAX_SHEAR, read_scalar
from dvc.measurement.subject import Subject
from dvc.report.drawing import Drawing
from dvc.report.sheet import PLANES, View, levelled, window_of
from dvc.report.strips import MEASURED, Strip, narrow_by_load, strain_by_load

FIGURE = "slices_by_load"
"""Stem of its files."""


def measured_by_load(subject: Subject, folders: Mapping[str, Path]) -> Drawing:
    """The unloaded image, and the measured strain of each load in one slice, from folders of results by load.

    The slice goes through the lowest point of the bone, or the middle of the body, and has the plate's normal in it.

    Raises
    ------
    InputError, ImageFileError
        If the maximum shear strain of a load is missing, damaged, or not on the voxels of the unloaded image.
    """
    reference, body, point = subject.reference, subject.body(), subject.lowest_bone_point_mm
    where = "the lowest point of the bone"
    if point is None:
        points, where = body.points(), "the middle of the tissue"
        point = points[int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    across = np.abs(subject.plate_normal) if subject.axes is None else 1.0 - np.abs(subject.axes[:, 2])
    plane = PLANES[int(np.argmin(across))]
    view = View.through(reference.grid, point, body.inside)
    image = levelled(view.cut(np.nan_to_num(reference.values), plane), window_of(view, reference.values))
    masks = (body.inside,) if subject.bone is None else (body.inside, subject.bone.inside)
    outlines, soft = tuple(view.cut(mask, plane) for mask in masks), view.cut(subject.soft(body), plane)
    strips = []
    for load, folder in folders.items():
        page = view.cut(read_scalar(folder / MAX_SHEAR, reference.grid).values, plane)
        shown = {MEASURED: np.where(soft, page, np.float32(np.nan))}
        strips.append(Strip(load, plane, view.extent_mm(plane), view.title(plane), where, image, outlines, shown))
    note = f"{strips[0].title}, through {where}."
    drawn = Drawing.of("Maximum shear strain under each load", strain_by_load, strips, (MEASURED,), note=note)
    return replace(drawn, narrow=narrow_by_load(strips, (MEASURED,)))
