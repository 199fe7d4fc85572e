"""The loads of one subject side by side: the first figure of a report on measurements alone."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvc.errors import MrstrainError
from dvc.io.result_folder import MAX_SHEAR, REGISTERED, REPEAT, read_scalar
from dvc.measurement.page import STRAIN, strain_drawing
from dvc.measurement.subject import Subject
from dvc.report.drawing import Drawing
from dvc.report.figures import scale_told, shear_scale
from dvc.report.page import Section
from dvc.report.sheet import PLANES, View, levelled, window_of
from dvc.report.strips import MEASURED, Strip, narrow_by_load, strain_by_load

FIGURE = "slices_by_load"
"""Stem of its files."""


def measured_by_load(subject: Subject, folders: Mapping[str, Path]) -> Drawing:
    """The unloaded image, and the measured strain of each load in one slice, from folders of results by load.

    The slice goes through the point of the bone nearest to the plate, or the middle of the body, and has the plate's
    normal in it.

    Raises
    ------
    InputError, ImageFileError
        If the maximum shear strain of a load is missing, damaged, or not on the voxels of the unloaded image.
    """
    reference, body, point = subject.reference, subject.body(), subject.lowest_bone_point_mm
    where = "the point of the bone nearest to the plate"
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
    largest = shared_scale(folders.values())
    drawn_of = strips, (MEASURED,), largest
    note += f" {scale_told(largest, among='report')}"
    drawn = Drawing.of("Maximum shear strain under each load", strain_by_load, *drawn_of, note=note)
    return replace(drawn, narrow=narrow_by_load(*drawn_of))


def shared_scale(folders: Iterable[Path]) -> float:
    """Where the colours of all maps of the maximum shear strain in a report end; errors as `measured_by_load`."""
    return max((shear_scale(read_scalar(folder / MAX_SHEAR).values) for folder in folders), default=shear_scale())


def on_one_scale(sections: Sequence[Section], subject: Subject, folders: Mapping[str, Path]) -> list[Section]:
    """Sections of loads whose pictures of the strain all have the colours of `shared_scale`, drawn anew where not.

    ``folders`` are those of the loads, by the sections' titles; a repeat scan has the colours of the loads. A picture
    stays if its files are missing or damaged; the others share the scale of those that can be read.
    """
    scales = list[float]()
    for folder in folders.values():
        with suppress(MrstrainError):
            scales += [] if folder.name == REPEAT else [shared_scale([folder])]
    if not scales:
        return list(sections)
    scale = max(scales)
    return [_on_scale(one, subject, folders[one.title], scale) if one.title in folders else one for one in sections]


def _on_scale(section: Section, subject: Subject, folder: Path, scale: float) -> Section:
    try:
        shear = read_scalar(folder / MAX_SHEAR, subject.reference.grid).values
        if shear_scale(shear) == scale:
            return section
        registered = folder / REGISTERED
        under = read_scalar(registered, subject.reference.grid) if registered.is_file() else None
    except MrstrainError:
        return section
    body = subject.body()
    view = View.through(subject.reference.grid, subject.lowest_bone_point_mm, np.isfinite(shear))
    loaded = "repeat" if folder.name == REPEAT else "loaded"
    drawing = strain_drawing(view, subject, subject.regions(body), shear, under, loaded=loaded, shared=scale)
    pictures = [drawing.picture() if one.title == STRAIN else one for one in section.pictures]
    return replace(section, pictures=tuple(pictures))
