"""A label map from an image and the mask of its bone, with the probability of each tissue."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dvc.arguments import checked
from dvc.arrays import BoolArray, Float32Array, FloatArray, frozen
from dvc.errors import InputError
from dvc.images.bias_field import without_bias_field
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.resample import fill_missing
from dvc.images.tissue import tissue_mask
from dvc.io.images.labels import fit_mask
from dvc.labelling.bones import other_bones
from dvc.labelling.brightness import brighter_share, two_levels
from dvc.labelling.skin import Skin

NAMES = {1: "bone", 2: "fat", 3: "muscle", 4: "skin", 5: "other bone"}
"""Numbers and names of the tissues that can be found."""
_DARK = 0.7  # of muscle's brightness: darker are cortical bone and tendon
_SURE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class TissueLabels:
    """Tissues that were found in an image.

    Attributes
    ----------
    labels : LabelMap
        The most probable tissue of each voxel, on the image's grid.
    probability : (n, ni, nj, nk) float32
        Probability of each tissue, in the order of ``labels.names``; 0 outside the body.
    notes : tuple of str
        What was not found, and why.
    """

    labels: LabelMap
    probability: Float32Array = field(repr=False)
    notes: tuple[str, ...] = ()

    @property
    def unsure(self) -> float:
        """Share of the voxels of the body whose tissue has a probability below 0.9."""
        inside = self.labels.labels > 0
        return float(np.mean(self.probability.max(axis=0)[inside] < _SURE))


@checked
def label_tissues(
    image: Image, bone: Mask, body: Mask | None = None, watch: Callable[[float], None] = lambda _: None
) -> TissueLabels:  # fmt: skip
    """Label skin, fat, muscle and other bones of an unloaded image, given its bone.

    Skin is a darker layer at the surface of the body, whose thickness varies slowly. Other bones are bright marrow in
    a dark rim. The rest is fat where it is brighter and muscle where it is darker, with short borders between them.
    Tendons and ligaments count as muscle.

    Parameters
    ----------
    image : Image
        Unloaded image, such as a T1- or proton-density-weighted one, where fat is brighter than muscle and skin.
    bone : Mask
        The bone, on any grid of the image's frame.
    body : Mask, optional
        The body. Default: found by an intensity threshold.
    watch : callable, optional
        Told how far it is, from 0 to 1.

    Raises
    ------
    InputError
        If the bone leaves no soft tissue in the body.
    GeometryError
        If a mask does not lie on the image.
    """
    grid, spacing = image.grid, image.grid.spacing_mm
    bone = fit_mask(bone, grid, "bone")
    whole = (tissue_mask(image) if body is None else fit_mask(body, grid, "body")).inside | bone.inside
    soft = whole & ~bone.inside
    if not soft.any():
        raise InputError("The bone leaves no soft tissue in the body. Check the masks.")
    watch(0.1)
    even = fill_missing(without_bias_field(image))
    watch(0.15)
    chance, notes = {"bone": bone.inside.astype(np.float32)}, list[str]()
    left = soft.astype(np.float32)  # probability that is not given to a tissue yet
    if (skin := Skin.of(even, Mask(grid, whole), bone.inside)) is None:
        notes.append("No skin was found: the image shows no darker layer at the surface of the body.")
    else:
        chance["skin"] = np.where(soft, skin.probability, 0.0).astype(np.float32)
        left -= chance["skin"]
    watch(0.5)
    chance |= _below_skin(even.values, soft & (left > 0.5), left, spacing)
    watch(1.0)
    if "muscle" not in chance:
        notes.append("One tissue was found below the skin: its brightness does not separate fat from muscle.")
    names = {number: name for number, name in NAMES.items() if name in chance}
    probability = np.stack([chance[name] for name in names.values()])
    labels = np.where(whole, np.array([*names])[probability.argmax(axis=0)], 0)
    return TissueLabels(LabelMap(grid, labels, names), frozen(probability, np.float32), tuple(notes))


def _below_skin(
    values: Float32Array, below: BoolArray, left: Float32Array, spacing_mm: FloatArray
) -> dict[str, Float32Array]:
    """Probability (ni, nj, nk) of the tissues below the skin, which share what is ``left`` of each voxel."""
    levels = two_levels(values, below, spacing_mm)
    if levels is None:
        return {"fat": left}
    bones = other_bones(values, below, _DARK * levels.darker, spacing_mm)
    share = brighter_share(values, below & ~bones, levels, spacing_mm)
    fat = np.where(bones, 0.0, left * share)
    tissues = {"fat": fat, "muscle": np.where(bones, 0.0, left - fat)}
    return tissues | ({"other bone": np.where(bones, left, 0.0)} if bones.any() else {})
