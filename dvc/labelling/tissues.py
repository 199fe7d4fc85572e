"""A label map from an image and the mask of its bone, or from a few marks, with the probability of each tissue."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import binary_fill_holes

from dvc.arguments import checked
from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray, frozen
from dvc.errors import InputError
from dvc.images.bias_field import without_bias_field
from dvc.images.bone_names import BONE, is_bones_name
from dvc.images.bone_rim import bone_to_rim
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.resample import fill_missing
from dvc.images.tissue import tissue_mask
from dvc.io.images.labels import fit_mask
from dvc.labelling.bones import bones_in
from dvc.labelling.brightness import Levels, brighter_share, two_levels
from dvc.labelling.marks import corrected, grown
from dvc.labelling.skin import Skin
from dvc.registration.bone_mask import mask_doubt

NAMES = {1: BONE, 2: "fat", 3: "muscle", 4: "skin", 5: "other bone"}
"""Numbers and names of the tissues that can be found without marks."""
_DARK = 0.7  # of muscle's brightness: darker are cortical bone and tendon
_SURE = 0.9
_LEAST_IN_BODY = 0.5  # of the bone
_LEAST_BONE = 16  # voxels
_BESIDE = 0.04  # beside skin and bone, between muscle (-1) and fat (1): voxels there are dark by their part of skin
_DARK_MARROW = 0.25  # of the step from muscle to fat: 0.5 and more in phantoms with slices of up to 3 mm


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
    def uncertain(self) -> float:
        """Share of the voxels of the body whose tissue has a probability below 0.9."""
        inside = self.labels.labels > 0
        return float(np.mean(self.probability.max(axis=0)[inside] < _SURE))


@checked
def label_tissues(
    image: Image, bone: Mask | None = None, body: Mask | None = None, marks: LabelMap | None = None,
    watch: Callable[[float], None] = lambda _: None, *, bone_is_exact: bool = False,
) -> TissueLabels:  # fmt: skip
    """Label the tissues of an unloaded image, given its bone, or a few marks.

    Skin is a darker layer at the surface of the body, whose thickness varies slowly. Bones are bright marrow in a dark
    rim. The rest is fat where it is brighter and muscle where it is darker, with short borders between them. Tendons
    and ligaments count as muscle, unless they are marked.

    Parameters
    ----------
    image : Image
        Unloaded image, such as a T1- or proton-density-weighted one, where fat is brighter than muscle and skin. Where
        it ends in missing voxels, nothing is labelled; holes in it are.
    bone : Mask, optional
        The bone, on any grid of the image's frame. Its surface is moved, by up to 2.5 times the mean voxel edge, by its
        mean distance to the outer edge of the bone's dark rim: in a neighbourhood of 6 mm and then, where it is still
        off by half a voxel, of 1.25 voxels. It stays where this is less than a fifth of a voxel, where the image shows
        no such rim, and in slices more than 2.1 times as thick as the other voxel edges.
    body : Mask, optional
        The body. Default: found by an intensity threshold.
    marks : LabelMap, optional
        A few voxels of each tissue, by name, on any grid of the image's frame. A bone that is marked is found inside
        its dark rim; marked fat and muscle tell their brightness; another tissue, such as tendon, is found where it is
        joined to its mark. Where a mark is in the wrong tissue, the tissues within 8 mm are found again. Marks in a
        bone that is given as a mask change nothing.
    watch : callable, optional
        Told how far it is, from 0 to 1.
    bone_is_exact : bool
        Whether the mask of the bone is kept as it is.

    Raises
    ------
    InputError
        If neither a bone nor the mark of one is given, a bone has fewer than 16 voxels, it or its mark is not where it
        can be, or no soft tissue is left.
    GeometryError
        If a mask does not lie on the image.
    """
    grid, spacing = image.grid, image.grid.spacing_mm
    marked = {} if marks is None else dict(_regions(fit_mask(marks, grid, "marks")))
    if bone is None and not any(map(is_bones_name, marked)):
        raise InputError(
            "A bone is needed to make a label map. Give its mask as `bone` (--bone on the command line), or strokes in "
            "it, under the name of a bone such as calcaneus, as `marks` (--marks)."
        )
    known = np.zeros(grid.shape, dtype=bool) if bone is None else fit_mask(bone, grid, "bone").inside
    if known.any() and (count := int(known.sum())) < _LEAST_BONE:
        raise InputError(
            f"The mask of the bone has only {count} of the image's voxels; a bone has thousands. Give the whole bone "
            "as bone (--bone), or mark a few of its voxels and give these as marks (--marks)."
        )
    whole = (tissue_mask(image) if body is None else fit_mask(body, grid, "body")).inside
    soft = whole & ~known
    if not soft.any():
        raise InputError("The bone leaves no soft tissue in the body. Check the masks.")
    if known.any() and (share := float(whole[known].mean())) < _LEAST_IN_BODY:
        raise InputError(
            f"Only {100 * share:.0f} % of the mask of the bone is inside the body. Either it was drawn on another "
            "image, or the mask of the body (--tissue on the command line) is incomplete. Check both."
        )
    whole = whole | known
    watch(0.1)
    even = fill_missing(without_bias_field(image))
    doubt = ""
    if known.any() and not bone_is_exact:
        doubt = mask_doubt(image, Mask(grid, known), Mask(grid, whole))
        known = bone_to_rim(even, Mask(grid, known), Mask(grid, whole))[0].inside
        soft = whole & ~known
    watch(0.15)
    skin = Skin.of(even, Mask(grid, whole), known | image.missing)
    watch(0.5)
    if image.missing.any():  # holes are filled, but the body ends where the image does
        soft = soft & binary_fill_holes(~image.missing)
        whole = soft | known
    marked, outside = _in_soft_tissue(marked, soft, known)
    chance, notes = {BONE: known.astype(np.float32)} if known.any() else {}, [doubt] if doubt else []
    left = soft.astype(np.float32)  # probability that is not given to a tissue yet
    if skin is None:
        notes.append("No skin was found: the image shows no darker layer at the surface of the body.")
    else:
        chance["skin"] = np.where(soft, skin.probability, 0.0).astype(np.float32)
        left -= chance["skin"]
    chance |= _below_skin(even.values, soft & (left > 0.5), left, spacing, marked)
    if {"fat", "muscle"} <= set(marked) and _marked_levels(even.values, marked) is None:
        notes.append(
            "Where fat is marked, the image is not brighter than where muscle is marked. Check the names of the "
            "strokes; if fat is suppressed, give an image in which it is bright."
        )
    if "muscle" not in chance:
        notes.append(
            "Fat and muscle could not be separated by intensity: only one tissue was found below the skin. Strokes in "
            "both (--marks) may help."
        )
    because = dict.fromkeys(outside, "they lie outside the body, or in the mask of the bone")
    because |= dict.fromkeys(set(marked) - set(chance), "the image does not show it as a tissue of its own")
    notes += [f"The strokes of {name} were not used: {because[name]}." for name in sorted(because)]
    watch(0.9)
    names = [name for name in NAMES.values() if name in chance] + sorted(set(chance) - {*NAMES.values()})
    probability = frozen(np.stack([chance[name] for name in names]), np.float32)
    if marked:
        at = {names.index(name): mark for name, mark in marked.items() if name in chance}
        probability = frozen(corrected(even.values, probability, soft, at, grid), np.float32)
    numbered = {number: name for number, name in NAMES.items() if name in chance}
    numbered |= dict(enumerate(names[len(numbered) :], len(NAMES) + 1))
    labels = np.where(whole, np.array([*numbered])[probability.argmax(axis=0)], 0)
    if _is_dark(even.values, known, labels):
        notes.append(
            "The bone is about as dark as muscle. If fat is suppressed in this image, fat and muscle are mistaken for "
            "each other: give an image in which fat is bright."
        )
    watch(1.0)
    return TissueLabels(LabelMap(grid, labels, numbered), probability, tuple(notes))


def _regions(marks: LabelMap) -> Iterator[tuple[str, BoolArray]]:
    """Marks by name; the names of tissues that can be found are written in small letters."""
    own = set(NAMES.values())
    for number, name in marks.names.items():
        if (mark := marks.labels == number).any():
            yield name.casefold() if name.casefold() in own else name, mark


def _is_dark(values: Float32Array, bone: BoolArray, labels: IntArray) -> bool:
    """Whether a bone, whose marrow is mostly fat, is about as dark as what is labelled muscle."""
    parts = bone, labels == 2, labels == 3
    if not all(part.any() for part in parts):
        return False
    marrow, fat, muscle = (float(np.median(values[part])) for part in parts)
    return marrow < muscle + _DARK_MARROW * (fat - muscle)


def _in_soft_tissue(
    marked: Mapping[str, BoolArray], soft: BoolArray, bone: BoolArray
) -> tuple[dict[str, BoolArray], list[str]]:
    """Marks where they can tell something, and the names of those that lie elsewhere.

    A bone's mark that touches the mask of the bone is one of this bone, which is known.
    """
    inside, outside = dict[str, BoolArray](), list[str]()
    for name, mark in marked.items():
        if is_bones_name(name) and (mark & bone).any():
            continue
        if name == BONE and bone.any():
            raise InputError(
                f"The strokes of {name} lie outside the mask of the bone. If they mark another bone, give its own "
                "name, such as talus (mark_names); if not, correct the mask."
            )
        if (mark & soft).any():
            inside[name] = mark & soft
        else:
            outside.append(name)
    return inside, outside


def _below_skin(
    values: Float32Array, below: BoolArray, left: Float32Array, spacing_mm: FloatArray, marked: Mapping[str, BoolArray]
) -> dict[str, Float32Array]:
    """Probability (ni, nj, nk) of the tissues below the skin, which share what is ``left`` of each voxel."""
    levels = _marked_levels(values, marked) or two_levels(values, below, spacing_mm)
    if levels is None:
        return {"fat": left}
    bones = _named_bones(values, below, _DARK * levels.darker, spacing_mm, marked)
    rest = below.copy()
    for inside in bones.values():
        rest &= ~inside
    tissues = {name: np.where(inside, left, 0.0).astype(np.float32) for name, inside in bones.items()}
    left = np.where(below & ~rest, 0.0, left).astype(np.float32)
    for name, mark in marked.items():
        if not is_bones_name(name) and name not in NAMES.values():
            tissues[name] = left * grown(values, mark & rest, rest, levels.darker, spacing_mm)
            left = left - tissues[name]
    fat = left * brighter_share(values, rest, levels, spacing_mm, beside=_BESIDE).astype(np.float32)
    return {"fat": fat, "muscle": left - fat} | tissues


def _marked_levels(values: Float32Array, marked: Mapping[str, BoolArray]) -> Levels | None:
    """Levels of fat and muscle, if both are marked and fat is the brighter one."""
    if not {"fat", "muscle"} <= set(marked):
        return None
    darker, brighter = (float(np.median(values[marked[name]])) for name in ("muscle", "fat"))
    return Levels(darker, brighter, 0.5 * (darker + brighter)) if darker < brighter else None


def _named_bones(
    values: Float32Array, below: BoolArray, dark: float, spacing_mm: FloatArray, marked: Mapping[str, BoolArray]
) -> dict[str, BoolArray]:
    """Bones by the names of their marks; those without a mark are "other bone"."""
    parts = bones_in(values, below, dark, spacing_mm)
    named, taken = dict[str, BoolArray](), dict[int, str]()
    for name, mark in marked.items():
        if not is_bones_name(name) or name == NAMES[5] or not (mark & below).any():
            continue
        number = int(np.bincount(parts[mark & below]).argmax())
        if number == 0:
            raise InputError(
                f"The mark of {name} is not in marrow inside a closed dark rim, so the bone cannot be found from it. "
                "Paint the whole bone and give its mask as bone (--bone)."
            )
        if number in taken:
            raise InputError(
                f"No dark rim separates {name} from {taken[number]}, so only one of them can be found from its mark. "
                "Paint the bone on which images are aligned and give its mask as bone (--bone)."
            )
        named[name], taken[number] = parts == number, name
    parts = np.where(np.isin(parts, list(taken)), 0, parts)
    return named | ({NAMES[5]: parts > 0} if (parts > 0).any() else {})
