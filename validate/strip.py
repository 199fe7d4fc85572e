"""The slice of one load that the first figure of a comparison shows: measured and simulated strain."""

from collections.abc import Sequence

import numpy as np

from dvc import Deformation, StrainField, evaluate_on_grid
from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.image import reordered_to_lps
from dvc.io.images.read import read_voxels
from dvc.report.sheet import AXES, PLANES, Plane, View, levelled, window_of
from dvc.report.strips import MEASURED, Strip
from validate.fe_result import FeResult
from validate.load_comparison import LoadComparison


def strip_of(one: LoadComparison, measured: Deformation, results: Sequence[FeResult], point_mm: FloatArray) -> Strip:
    """The voxel slice through a point, LPS mm, that is closest to the plane of the plate's normal and shear."""
    labels, scanned = one.labels, one.case.image
    across = np.abs(np.cross(one.case.axes[:, 0], one.case.axes[:, 1]))
    plane = PLANES[int(np.argmax(across))]
    view = View.through(labels.grid, point_mm, labels.labels > 0)
    bones = [number for number, name in labels.names.items() if name in one.bones]
    shown = (labels.labels > 0) + 1.0 * np.isin(labels.labels, bones)
    if scanned is not None:
        seen, voxels = read_voxels(scanned)
        shown = np.nan_to_num(voxels) if seen.same_as(labels.grid) else shown
    soft = (labels.labels > 0) & ~np.isin(labels.labels, bones) & _in_slice(view, plane)
    fields: dict[str, Deformation] = {MEASURED: measured} | {r.name: r.deformation for r in results}
    pages: dict[str, Float32Array] = {}
    for name, field in fields.items():
        values = np.full(labels.grid.shape, np.nan, dtype=np.float32)
        values[soft] = StrainField.from_gradient(evaluate_on_grid(field, labels.grid, soft)[1]).max_shear
        pages[name] = view.cut(values, plane)
    masks = labels.labels > 0, np.isin(labels.labels, bones)
    return Strip(
        one.load, plane, view.extent_mm(plane), view.title(plane),
        "the point of the bone nearest to the plate" if one.bones else "the middle of the mesh",
        levelled(view.cut(shown, plane), window_of(view, shown)),
        tuple(view.cut(mask, plane) for mask in masks), pages,
    )  # fmt: skip


def _in_slice(view: View, plane: Plane) -> BoolArray:
    """The voxels (ni, nj, nk) of a grid that are in the slice of a view."""
    inside, at = np.zeros(view.grid.shape, dtype=bool), AXES[plane][0]
    everywhere = [slice(None)] * 3
    everywhere[at] = slice(view.index[at], view.index[at] + 1)
    reordered_to_lps(view.grid, inside)[tuple(everywhere)] = True
    return inside
