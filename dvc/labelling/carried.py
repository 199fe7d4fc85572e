"""Another subject's label map, transferred to an image by registration and combined with what the image shows."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from dvc.arguments import checked
from dvc.arrays import Float32Array, frozen
from dvc.deformation.protocol import Deformation
from dvc.errors import InputError, RegistrationError
from dvc.images.bias_field import without_bias_field
from dvc.images.bone_names import is_bones_name
from dvc.images.depth import depth_mm
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.images.tissue import tissue_mask
from dvc.io.images.labels import fit_mask
from dvc.labelling.boundaries import correct_labels
from dvc.labelling.near_marks import corrected_near
from dvc.labelling.tissues import NAMES, TissueLabels, label_tissues
from dvc.measurement.subject import bones_of
from dvc.registration.affine_fit import affine_fit, parts_of
from dvc.registration.gauss_newton.engine import GaussNewton
from dvc.registration.register import Settings, register
from dvc.threads import usable_cores

# Two subjects: textures differ, so a stiff spline; neither volume nor the shape of a bone is kept.
ENGINE = GaussNewton(bending=10.0, volume=0.0, rigidity=0.0)
_OFF_MM = 1.0  # standard deviation of a boundary that is transferred
_LEAST_COVERED = 0.8  # of the body by the transferred labels
_LEAST_SHARE = 0.2  # of a tissue in the image: what is found there may be wrong
_LEAST_CHANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class CarriedLabels:
    """A label map transferred to another subject's image, with the probability (n, ni, nj, nk) of each label."""

    labels: LabelMap
    probability: Float32Array


@checked
def labels_from(
    image: Image, other: Image, labels: LabelMap, bone: Mask | None = None, body: Mask | None = None, *,
    marks: LabelMap | None = None, watch: Callable[[float], None] = lambda _: None,
) -> TissueLabels:  # fmt: skip
    """Label the tissues of an unloaded image, given another subject's image and its label map.

    The label map is transferred by an affine and a non-rigid registration. Its bone is corrected by the image
    (`correct_labels`), and skin, fat, muscle and other bones are found from it (`label_tissues`). The probability of a
    label is that of its tissue in the image times that of the transferred label. A tissue that the image alone does
    not show, such as tendon, stays where the registration puts it.

    Parameters
    ----------
    image : Image
        Unloaded image, as in `label_tissues`.
    other : Image
        Unloaded image of another subject: the same part and side of the body, the same contrast.
    labels : LabelMap
        Tissues of the other image, on any grid of its frame. One is named like a bone.
    bone : Mask, optional
        The bone, if it is known, on any grid of the image's frame; it is kept unchanged.
    body : Mask, optional
        The body in the image. Default: found by an intensity threshold.
    marks : LabelMap, optional
        A few voxels of each tissue, by name, on any grid of the image's frame. Where they do not agree with the labels,
        these are corrected as in `correct_labels`.
    watch : callable, optional
        Called with the fraction that is done, 0 to 1.

    Returns
    -------
    TissueLabels
        With the names and numbers of the other subject's labels.

    Raises
    ------
    InputError
        If no label is named like a bone, or as in `label_tissues`.
    GeometryError
        If a mask or label map does not lie on its image.
    RegistrationError
        If the two bodies do not correspond.
    """
    if not set(bones_of(labels)) & set(labels.names.values()):
        raise InputError(
            "No label of the other subject is named like a bone, such as calcaneus, so no bone can be transferred. "
            "Check the names (names)."
        )
    whole = fit_mask(body, image.grid, "body") if body is not None else tissue_mask(image)
    theirs = fit_mask(labels, other.grid, "labels")
    carried = carry_labels(image, other, theirs, whole, lambda share: watch(0.7 * share))
    made = combined(image, other, theirs, carried, bone, whole, lambda share: watch(0.7 + 0.3 * share))
    return made if marks is None else corrected_near(image, made, marks, bone)


def carry_labels(
    image: Image, other: Image, labels: LabelMap, body: Mask, watch: Callable[[float], None] = lambda _: None
) -> CarriedLabels:
    """Transfer another subject's label map to the body in an image; arguments as in `labels_from`, on their grids.

    The probability is that of a label whose boundary is off by 1 mm (standard deviation). RegistrationError if the
    labels cover less than 80 % of the body.
    """
    theirs = Mask(other.grid, labels.labels > 0)
    affine = affine_fit(without_bias_field(image), without_bias_field(other), body, theirs)
    rigid, stretch = parts_of(affine, body)
    back = rigid.inverse()
    grid = other.grid.moved_by(back.rotation, back.translation_mm)  # nothing is resampled
    watch(0.2)
    found = register(
        image, Image(grid, other.values), tissue=body, start=stretch,
        settings=Settings(ENGINE, threads=usable_cores(), align_on="none"),
        progress=lambda stage, share: None if stage == "aligning" else watch(0.2 + 0.7 * share),
    )  # fmt: skip
    carried = _sampled(LabelMap(grid, labels.labels, labels.names), found.total, image.grid, body)
    watch(1.0)
    return carried


def combined(
    image: Image, other: Image, labels: LabelMap, carried: CarriedLabels, bone: Mask | None, body: Mask,
    watch: Callable[[float], None] = lambda _: None,
) -> TissueLabels:  # fmt: skip
    """Transferred labels (`carry_labels`), combined with the tissues that the image shows in the body."""
    (name, *_), known = bones_of(labels), bone
    if known is None:
        known = correct_labels(image, carried.labels, watch=lambda share: watch(0.4 * share)).labels.region(name)
    found = label_tissues(image, known, body, watch=lambda share: watch(0.4 + 0.6 * share), bone_is_exact=True)
    return _weighed(found, carried, _groups(found, other, labels, name))


def _sampled(labels: LabelMap, total: Deformation, grid: Grid, body: Mask) -> CarriedLabels:
    """Labels where a deformation takes the voxels of a body."""
    points = body.points()
    at = labels.grid.indices_of(points + total.displacement(points)).T
    spacing, numbers = labels.grid.spacing_mm, [n for n in labels.names if (labels.labels == n).any()]
    there = map_coordinates((labels.labels > 0).astype(np.float32), at, order=1, mode="nearest") > 0.5
    if (covered := float(np.mean(there))) < _LEAST_COVERED:
        raise RegistrationError(
            f"The other subject's labels cover {100 * covered:.0f} % of the body after the registration. Check that "
            "both images show the same part and side of the body; if not, mirror or choose another subject."
        )
    depth = np.stack(
        [map_coordinates(depth_mm(labels.labels == n, spacing), at, order=1, mode="nearest") for n in numbers]
    )
    chance = ndtr(depth / _OFF_MM) + _LEAST_CHANCE  # no voxel without a label
    values = np.zeros(grid.shape, dtype=np.int64)
    values[body.inside] = np.array(numbers)[depth.argmax(axis=0)]
    probability = np.zeros((len(numbers), *grid.shape), dtype=np.float32)
    probability[:, body.inside] = chance / chance.sum(axis=0)
    names = {n: labels.names[n] for n in numbers}
    return CarriedLabels(LabelMap(grid, values, names), frozen(probability, np.float32))


def _groups(found: TissueLabels, other: Image, labels: LabelMap, bone: str) -> Mapping[str, list[int]]:
    """The labels of the other subject, by number, that each tissue found in the image consists of.

    A tissue that was not found by its own name belongs to fat or to muscle, whichever has its brightness.
    """
    here, even = set(found.labels.names.values()), without_bias_field(other).values
    level = {
        name.casefold(): float(np.nanmedian(even[labels.labels == n]))
        for n, name in labels.names.items() if (labels.labels == n).any()
    }  # fmt: skip
    middle = 0.5 * (level.get("fat", np.inf) + level.get("muscle", np.inf))
    groups: dict[str, list[int]] = {}
    for number, name in labels.names.items():
        own = name.casefold()
        if own not in level:
            continue
        if name == bone:
            group = NAMES[1]
        elif own in here:
            group = own
        elif is_bones_name(name) and NAMES[5] in here:
            group = NAMES[5]
        else:
            group = "fat" if level[own] > middle or "muscle" not in here else "muscle"
        groups.setdefault(group, []).append(number)
    return groups


def _weighed(found: TissueLabels, carried: CarriedLabels, groups: Mapping[str, list[int]]) -> TissueLabels:
    """Tissues found in the image, with the transferred labels as the prior (Bayes).

    The probability of a label is that of its tissue in the image, at least a fifth, times that of the transferred
    label; the bone is known.
    """
    grid, numbers = found.labels.grid, [*carried.labels.names]
    names, known = dict(carried.labels.names), found.labels.region(NAMES[1]).inside
    chance = np.zeros((len(numbers), *grid.shape), dtype=np.float32)
    for tissue, share in zip(found.labels.names.values(), found.probability, strict=True):
        for number in groups.get(tissue, []):
            place = numbers.index(number)
            if tissue == NAMES[1]:
                chance[place] = known
            else:
                seen = np.where(known, 0.0, np.maximum(share, _LEAST_SHARE))
                chance[place] = seen * (carried.probability[place] + _LEAST_CHANCE)
    body = found.labels.labels > 0
    probability = np.where(body, chance / np.maximum(chance.sum(axis=0), _LEAST_CHANCE**2), 0.0)
    labels = np.where(body, np.array(numbers)[probability.argmax(axis=0)], 0)
    return TissueLabels(LabelMap(grid, labels, names), frozen(probability, np.float32), found.notes)
