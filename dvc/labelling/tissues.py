"""A label map from an image and the mask of its bone, or from a few marks, with the probability of each tissue."""

from collections.abc import Callable, Iterator, Mapping
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
from dvc.labelling.bones import bones_in
from dvc.labelling.brightness import Levels, brighter_share, two_levels
from dvc.labelling.marks import corrected, grown
from dvc.labelling.skin import Skin
from dvc.measurement.subject import is_bones_name

NAMES = {1: "bone", 2: "fat", 3: "muscle", 4: "skin", 5: "other bone"}
"""Numbers and names of the tissues that can be found without marks."""
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
    image: Image, bone: Mask | None = None, body: Mask | None = None, marks: LabelMap | None = None,
    watch: Callable[[float], None] = lambda _: None,
) -> TissueLabels:  # fmt: skip
    """Label the tissues of an unloaded image, given its bone, or a few marks.

    Skin is a darker layer at the surface of the body, whose thickness varies slowly. Bones are bright marrow in a dark
    rim. The rest is fat where it is brighter and muscle where it is darker, with short borders between them. Tendons
    and ligaments count as muscle, unless they are marked.

    Parameters
    ----------
    image : Image
        Unloaded image, such as a T1- or proton-density-weighted one, where fat is brighter than muscle and skin.
    bone : Mask, optional
        The bone, on any grid of the image's frame.
    body : Mask, optional
        The body. Default: found by an intensity threshold.
    marks : LabelMap, optional
        A few voxels of each tissue, by name, on any grid of the image's frame. A bone that is marked is found inside
        its dark rim; marked fat and muscle tell their brightness; another tissue, such as tendon, is found where it is
        joined to its mark. Where a mark is in the wrong tissue, the tissues within 8 mm are found again.
    watch : callable, optional
        Told how far it is, from 0 to 1.

    Raises
    ------
    InputError
        If neither a bone nor the mark of one is given, a marked bone has no closed dark rim, or no soft tissue is left.
    GeometryError
        If a mask does not lie on the image.
    """
    grid, spacing = image.grid, image.grid.spacing_mm
    marked = {} if marks is None else dict(_regions(fit_mask(marks, grid, "marks")))
    if bone is None and not any(map(is_bones_name, marked)):
        raise InputError("Labels need the mask of a bone (bone), or the mark of one, such as 'calcaneus' (marks).")
    known = np.zeros(grid.shape, dtype=bool) if bone is None else fit_mask(bone, grid, "bone").inside
    whole = (tissue_mask(image) if body is None else fit_mask(body, grid, "body")).inside | known
    soft = whole & ~known
    if not soft.any():
        raise InputError("The bone leaves no soft tissue in the body. Check the masks.")
    watch(0.1)
    even = fill_missing(without_bias_field(image))
    watch(0.15)
    chance, notes = {NAMES[1]: known.astype(np.float32)} if known.any() else {}, list[str]()
    left = soft.astype(np.float32)  # probability that is not given to a tissue yet
    if (skin := Skin.of(even, Mask(grid, whole), known)) is None:
        notes.append("No skin was found: the image shows no darker layer at the surface of the body.")
    else:
        chance["skin"] = np.where(soft, skin.probability, 0.0).astype(np.float32)
        left -= chance["skin"]
    watch(0.5)
    chance |= _below_skin(even.values, soft & (left > 0.5), left, spacing, marked)
    if "muscle" not in chance:
        notes.append("One tissue was found below the skin: its brightness does not separate fat from muscle.")
    unused = [name for name, mark in marked.items() if name not in chance and (mark & ~known).any()]
    notes += [
        f"The marks of {name} were not used: the image does not show it as a tissue of its own." for name in unused
    ]
    watch(0.9)
    names = [name for name in NAMES.values() if name in chance] + sorted(set(chance) - {*NAMES.values()})
    probability = frozen(np.stack([chance[name] for name in names]), np.float32)
    if marked:
        at = {names.index(name): mark & whole for name, mark in marked.items() if name in chance}
        probability = frozen(corrected(even.values, probability, at, grid), np.float32)
    numbered = {number: name for number, name in NAMES.items() if name in chance}
    numbered |= dict(enumerate(names[len(numbered) :], len(NAMES) + 1))
    labels = np.where(whole, np.array([*numbered])[probability.argmax(axis=0)], 0)
    watch(1.0)
    return TissueLabels(LabelMap(grid, labels, numbered), probability, tuple(notes))


def _regions(marks: LabelMap) -> Iterator[tuple[str, BoolArray]]:
    """Marks by name; the names of tissues that can be found are written in small letters."""
    own = set(NAMES.values())
    for number, name in marks.names.items():
        if (mark := marks.labels == number).any():
            yield name.casefold() if name.casefold() in own else name, mark


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
    fat = left * brighter_share(values, rest, levels, spacing_mm).astype(np.float32)
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
    named: dict[str, BoolArray] = {}
    for name, mark in marked.items():
        if not is_bones_name(name) or not (mark & below).any():
            continue
        number = int(np.bincount(parts[mark & below]).argmax())
        if number == 0:
            raise InputError(
                f"The mark of {name} is not in marrow inside a closed dark rim, so the bone cannot be found from it. "
                "Paint the whole bone and give it as the mask (bone)."
            )
        named[name] = parts == number
        parts = np.where(named[name], 0, parts)
    return named | ({NAMES[5]: parts > 0} if (parts > 0).any() else {})
