"""A label map with its probabilities, however it was made, corrected near the marks that contradict it."""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from dvc.arrays import BoolArray, Float32Array, frozen
from dvc.errors import InputError, few
from dvc.images.bias_field import without_bias_field
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.resample import fill_missing
from dvc.io.images.labels import fit_mask
from dvc.labelling.marks import corrected
from dvc.labelling.tissues import TissueLabels
from dvc.measurement.subject import bones_of

_BONE = "bone"  # a mark of this name is one of the bone, whatever the label map calls it


def corrected_near(image: Image, found: TissueLabels, marks: LabelMap, bone: Mask | None = None) -> TissueLabels:
    """Labels found again within 8 mm of the marks that they do not agree with (`dvc.labelling.marks.corrected`).

    All other labels and probabilities are kept bit for bit, and so is the outline of the body.

    Parameters
    ----------
    image : Image
        Unloaded image.
    found : TissueLabels
        Labels on the image's grid, each the most probable one.
    marks : LabelMap
        A few voxels of each tissue, by name, on any grid of the image's frame. A tissue that the labels do not have is
        added to them.
    bone : Mask, optional
        A bone that stays as it is: marks in it change nothing.

    Raises
    ------
    InputError
        If the probabilities are not those of the labels, or the labels have no names that marks could refer to.
    GeometryError
        If marks or bone do not lie on the image.
    """
    grid, labels = image.grid, found.labels
    where = labels.labels > 0
    numbers = np.array([*labels.names])
    if len(found.probability) != len(numbers) or not np.array_equal(
        numbers[found.probability.argmax(axis=0)][where], labels.labels[where]
    ):
        raise InputError("The probabilities (probability) are not those of the labels. Give both as they were made.")
    if bone is not None:
        where = where & ~fit_mask(bone, grid, "bone").inside
    marked, notes = _by_name(labels, fit_mask(marks, grid, "marks")), [*found.notes]
    for name in [name for name, mark in marked.items() if not (mark & where).any()]:
        del marked[name]
        outside = "outside the label map" + ("" if bone is None else ", or in the mask of the bone")
        notes.append(f"The strokes of {name} were not used: they lie {outside}.")
    new = [name for name in marked if name not in labels.names.values()]
    names = dict(labels.names) | dict(enumerate(new, max(labels.names) + 1))
    empty = np.zeros((len(new), *grid.shape), dtype=np.float32)
    probability = np.concatenate([found.probability, empty]) if new else found.probability
    places = [*names.values()]
    at = {places.index(name): mark & where for name, mark in marked.items()}
    even = fill_missing(without_bias_field(image))
    probability = corrected(even.values, probability, where, at, grid)
    again = np.where(where, np.array([*names])[probability.argmax(axis=0)], labels.labels)
    return TissueLabels(LabelMap(grid, again, names), frozen(probability, np.float32), tuple(notes))


def certain(labels: LabelMap) -> Float32Array:
    """Probability (n, ni, nj, nk) of labels that were drawn: 1 for the label of a voxel, 0 for the others."""
    return frozen(np.stack([labels.labels == number for number in labels.names]), np.float32)


def _by_name(labels: LabelMap, marks: LabelMap) -> dict[str, BoolArray]:
    """Marks by the names of the labels that they mean; a mark of "bone" is one of the first bone."""
    own: Mapping[str, str] = {name.casefold(): name for name in labels.names.values()}
    bones, named = bones_of(labels), defaultdict[str, BoolArray](lambda: np.zeros(marks.grid.shape, dtype=bool))
    for number, name in marks.names.items():
        if (mark := marks.labels == number).any():
            usual = bones[0] if bones and name.casefold() == _BONE else name
            named[own.get(name.casefold(), usual)] |= mark
    unknown = sorted(set(named) - set(own.values()))
    if unknown and all(name == f"label-{number}" for number, name in labels.names.items()):
        raise InputError(
            f"The labels have no names, so that strokes of {few(unknown)} cannot be assigned to them. Give a table of "
            "their names as names (--names)."
        )
    return dict(named)
