"""A label map that was drawn or made before, corrected: by the image, or near a few marks."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dvc.arguments import checked
from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.errors import InputError
from dvc.images.bias_field import without_bias_field
from dvc.images.bone_names import is_bones_name
from dvc.images.bone_rim import as_dark_as_rims, bone_to_rim, reach_of
from dvc.images.depth import depth_mm, moved_mm
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.resample import fill_missing
from dvc.images.tissue import tissue_mask, within
from dvc.labelling.near_marks import certain, corrected_near
from dvc.labelling.skin import Skin
from dvc.labelling.tissues import TissueLabels


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedLabels:
    """A label map that was corrected.

    Attributes
    ----------
    labels : LabelMap
        On the image's grid; the outline of the body is as given.
    changed : float
        Share of the labelled voxels that have another label.
    moved_mm : mapping
        Mean and root mean square of how far the boundaries of "bone" and "skin" moved, mm, by name: above zero where
        the bone grew, or the skin became thicker. Empty with marks.
    notes : tuple of str
        What was left as it was, and why.
    probability : (n, ni, nj, nk) float32 or None
        With marks: probability of each tissue, in the order of ``labels.names``.
    """

    labels: LabelMap
    changed: float
    moved_mm: Mapping[str, tuple[float, float]]
    notes: tuple[str, ...] = ()
    probability: Float32Array | None = field(default=None, repr=False)


@checked
def correct_labels(
    image: Image, labels: LabelMap, *, marks: LabelMap | None = None, probability: Float32Array | None = None,
    watch: Callable[[float], None] = lambda _: None,
) -> CorrectedLabels:  # fmt: skip
    """Correct a label map near a few marks; or, without marks, the boundaries of its bones and skin.

    With marks, labels within 8 mm of a mark that they do not agree with are found again, and all others are kept.
    Without, the boundaries of bones and skin move to where the image shows them, by up to 2.5 times the mean voxel
    edge. A bone ends where its dark rim becomes as bright as the tissue beside it; skin ends where the brightness below
    the surface rises. Where the image shows no such edge, the boundary stays. What becomes bone or soft tissue gets the
    nearest label of that kind.

    Parameters
    ----------
    image : Image
        Unloaded image, in which fat is brighter than skin and cortical bone.
    labels : LabelMap
        Tissues on the image's grid. Bones are the labels that are named like one, and skin is the one named "skin".
    marks : LabelMap, optional
        A few voxels of each tissue, by name, on any grid of the image's frame. A tissue that the labels do not have is
        added to them. Of the tissues near a mark, only its own and those that it contradicts change.
    probability : (n, ni, nj, nk), optional
        With marks: probability of each tissue, in the order of ``labels.names``, such as `label_tissues` gives.
        Default: that of a drawn label, 1.
    watch : callable, optional
        Told how far it is, from 0 to 1.

    Raises
    ------
    InputError
        If the labels are on another grid; without marks, if none is a bone or skin; with marks, if the labels have no
        names or the probability is not theirs.
    GeometryError
        If the marks do not lie on the image.
    """
    grid, given, spacing = image.grid, labels.labels, image.grid.spacing_mm
    if not labels.grid.same_as(grid):
        raise InputError("The labels are on another grid than the image; resample them with `fit_mask`.")
    if marks is not None:
        before = TissueLabels(labels, certain(labels) if probability is None else probability)
        return _by_marks(image, before, marks, watch)
    if probability is not None:
        raise InputError("The probability of each tissue (probability) can be corrected by marks only: give both.")
    bones, skin = correctable(labels)
    watch(0.1)
    even, body, reach = fill_missing(without_bias_field(image)), given > 0, reach_of(spacing)
    watch(0.2)
    notes, ends = list[str](), _without_labels(image, body, spacing, reach)
    whole, fixed = body | ends, within(ends, spacing, reach)
    if ends.any():
        notes.append("Where the label map ends inside tissue (truncation surface), boundaries were not corrected.")
    new_skin = skin
    if skin.any():
        near_bone = distance_transform_edt(~bones, sampling=spacing) <= reach if bones.any() else bones
        found = Skin.of(even, Mask(grid, whole), near_bone | ends)
        if found is None:
            notes.append("The skin is unchanged: the image shows no darker layer at the surface of the body.")
        else:
            at_border = (np.abs(depth_mm(whole & ~skin, spacing)) <= reach) & ~fixed
            new_skin = np.where(at_border & ~bones, found.probability > 0.5, skin) & body
    watch(0.6)
    tissues = (given == number for number in np.unique(given[body & ~bones]))
    around = whole & ~bones & ~new_skin
    dark, new_bones = as_dark_as_rims(even, bones, around, tissues), np.zeros_like(bones)
    for bone in _apart(given, bones):
        found_bone = bone_to_rim(even, Mask(grid, bone), Mask(grid, bone | around), dark=dark)[0].inside
        new_bones |= np.where(fixed, bone, found_bone) & body
    watch(0.9)
    others = body & ~bones & ~skin
    corrected = np.where(new_bones, _nearest(given, bones), np.where(new_skin, _nearest(given, skin), 0))
    corrected = np.where(body & ~new_bones & ~new_skin, _nearest(given, others), corrected)
    moved = {
        name: moved_mm(was, now, spacing)
        for name, was, now in (("bone", bones, new_bones), ("skin", ~(body & ~skin), ~(body & ~new_skin)))
        if (was & body).any()
    }
    watch(1.0)
    result = LabelMap(grid, corrected, labels.names)
    return CorrectedLabels(result, _changed(labels, result), moved, tuple(notes))


def _by_marks(
    image: Image, given: TissueLabels, marks: LabelMap, watch: Callable[[float], None]
) -> CorrectedLabels:  # fmt: skip
    """The labels as they are after they were corrected near marks."""
    watch(0.1)
    made = corrected_near(image, given, marks)
    watch(1.0)
    return CorrectedLabels(made.labels, _changed(given.labels, made.labels), {}, made.notes, made.probability)


def correctable(labels: LabelMap) -> tuple[BoolArray, BoolArray]:
    """Voxels (ni, nj, nk) of bones and of skin, which `correct_labels` corrects; InputError if there are none."""
    names = labels.names.items()
    bones = np.isin(labels.labels, [number for number, name in names if is_bones_name(name)])
    skin = np.isin(labels.labels, [number for number, name in names if name.casefold() == "skin"])
    if not (bones.any() or skin.any()):
        raise InputError("No label is named skin, or like a bone, so there is no boundary to correct. Check the names.")
    return bones, skin


def _changed(before: LabelMap, after: LabelMap) -> float:
    """Share of the labelled voxels that have another label."""
    body = before.labels > 0
    return float(np.mean(after.labels[body] != before.labels[body]))


def _without_labels(image: Image, body: BoolArray, spacing_mm: FloatArray, reach_mm: float) -> BoolArray:
    """Tissue beyond the labels (ni, nj, nk): where it is thicker than a body that was drawn a voxel too small."""
    unlabelled = ~body
    with suppress(InputError):  # the image shows no air
        unlabelled &= tissue_mask(image).inside
    if not unlabelled.any():
        return unlabelled
    deep = distance_transform_edt(unlabelled, sampling=spacing_mm) > reach_mm
    return within(deep, spacing_mm, 1.5 * reach_mm) & unlabelled


def _apart(labels: IntArray, bones: BoolArray) -> Iterator[BoolArray]:
    """Bones (ni, nj, nk) that touch no other: labels that do are one, since between them the image may show no rim."""
    if not bones.any():
        return
    numbers, of_label = np.unique(labels[bones], return_inverse=True)
    parts = label(bones)[0][bones] - 1
    touch = coo_array((np.ones(len(parts)), (of_label, parts)), shape=(len(numbers), int(parts.max()) + 1))
    _, group = connected_components(touch @ touch.T, directed=False)
    for one in range(int(group.max()) + 1):
        yield np.isin(labels, numbers[group == one])


def _nearest(labels: IntArray, where: BoolArray) -> IntArray:
    """The label of the nearest of some voxels, at every voxel; as given if there are none."""
    if not where.any():
        return labels
    return np.asarray(labels[tuple(distance_transform_edt(~where, return_distances=False, return_indices=True))])
