"""Figures of a label map made or corrected by an image: tissues, and where they are uncertain or were changed."""

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from dvc.arrays import Float32Array
from dvc.images.image import Image, LabelMap
from dvc.report.sheet import Sheet, View, window_of
from dvc.report.style import SMALL, TISSUES, looks

_CHANGED = "#d62728"


def tissue_slices(view: View, image: Image, labels: LabelMap) -> Figure:
    """Tissues in colour over the unloaded image."""
    sheet = Sheet(view, ["Tissues"])
    _tissues(sheet, view, image, labels)
    return sheet.finished()


def label_slices(view: View, image: Image, labels: LabelMap, probability: Float32Array) -> Figure:
    """Tissues in colour over the unloaded image, and the probability of the label of each voxel.

    Dark places in the lower row are those to look at: there another tissue is about as likely.
    """
    sheet, window = Sheet(view, ["Tissues", "Probability of the label"], bar=True), window_of(view, image.values)
    _tissues(sheet, view, image, labels)
    sure = np.where(labels.labels > 0, probability.max(axis=0), np.nan)
    shades, norm = colormaps["cividis"], Normalize(0.5, 1.0)
    for plane, axes in sheet.rows[1].items():
        sheet.grey(plane, axes, image.values, window)
        sheet.colours(plane, axes, sure, shades, norm)
    sheet.bar(shades, norm, "probability of the label", "min")
    return sheet.finished()


def changed_slices(view: View, image: Image, given: LabelMap, corrected: LabelMap) -> Figure:
    """Corrected tissues in colour over the unloaded image, and in red the voxels whose label was another before.

    In the lower row, the edges of the image should lie along the outer or inner side of what is red.
    """
    sheet, window = Sheet(view, ["Corrected tissues", "Changed labels"]), window_of(view, image.values)
    _tissues(sheet, view, image, corrected)
    changed = given.labels != corrected.labels
    for plane, axes in sheet.rows[1].items():
        sheet.grey(plane, axes, image.values, window)
        cut = view.cut(changed, plane)
        page = np.zeros((*cut.shape, 4))
        page[cut] = to_rgba(_CHANGED, 0.55)
        sheet.paint(plane, axes, page, interpolation="nearest")
    return sheet.finished()


def _tissues(sheet: Sheet, view: View, image: Image, labels: LabelMap) -> None:
    """Tissues in colour over the image, in the first row, with their names."""
    window, looked = window_of(view, image.values), looks(labels.names.values(), TISSUES)
    colours = {number: looked[name].colour for number, name in labels.names.items()}
    for plane, axes in sheet.rows[0].items():
        sheet.grey(plane, axes, image.values, window)
        cut = view.cut(labels.labels, plane)
        page = np.zeros((*cut.shape, 4))
        for number, colour in colours.items():
            page[cut == number] = to_rgba(colour, 0.45)
        sheet.paint(plane, axes, page, interpolation="nearest")
    named = [Patch(color=colours[number], alpha=0.6, label=name) for number, name in labels.names.items()]
    last = list(sheet.rows[0].values())[-1]
    last.legend(handles=named, loc="lower right", framealpha=0.8, prop={"family": SMALL["family"], "size": 8})
