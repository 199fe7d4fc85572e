"""Rigid alignment of a loaded image on a bone of the unloaded one.

First a search that cannot be trapped: the bone is placed everywhere in the loaded image in many orientations, at low
resolution, and normalised correlation is taken by FFT (masked template matching; D. Padfield, Masked object
registration in the Fourier domain, 2012, doi:10.1109/TIP.2011.2181402). Gauss-Newton (`dvc.registration.rigid_fit`)
refines the best places, and the header's last: a fit from there alone may end where a shaft looks right but for its
ends. Around the best of all, halves of the bone are fitted each by itself, begun to either side along each of the six
ways to move. Their mean is the result; the largest distance of two is its repeatability.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, Self

import numpy as np
from scipy import fft
from scipy.spatial.transform import Rotation

from dvc import threads
from dvc.arrays import FloatArray
from dvc.deformation.protocol import Composed, Deformation, RigidMotion
from dvc.errors import InputError, RegistrationError
from dvc.images.image import Grid, Image, Mask
from dvc.images.resample import Carrier, carry, fill_missing, smoothed
from dvc.images.similarity import local_correlation
from dvc.images.tissue import widened
from dvc.registration.rigid_fit import RigidFit, apart_mm

AlignOn = Literal["bone", "image", "none"]

_SEARCH_MM = 4.0
_SEARCH_MARGIN_MM = 4.0
_ROTATION_STEP_DEG = 9.0
_ROTATION_LIMIT_DEG = 27.0
_CANDIDATES = 3
_SCORE_MARGIN_MM = 2.0
_SCORE_BLUR_MM = 1.0
_BLUR_REACH = 4.5  # standard deviations of a blur, beyond which it takes nothing from
_LOWEST_SIMILARITY = 0.5
_CERTAIN_SIMILARITY = 0.9
_LARGEST_SPREAD_MM = 0.5
_LEAST_COVERED = 0.75
_LEAST_VARIANCE = 1e-3  # of the scene under the template, as a share of the whole scene's
_INVERTED_TRIES = 7
_CLEARLY = 0.1

_OTHER_MEASURE = (
    "their contrast differs, as between water and fat images. Correlation cannot match them, but mutual information "
    'could: use a parameter file with (Metric "AdvancedMattesMutualInformation")'
)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The rigid motion of the bone between two scans, and its repeatability.

    Attributes
    ----------
    motion : RigidMotion
        Takes points of the reference image to those of the loaded image, LPS mm.
    on : {"bone", "image", "none"}
        What was aligned.
    similarity_before, similarity : float
        Normalised correlation in and 2 mm around the bone (over the whole mask with "image"), before and after.
    repeatability_mm : float
        Distance between the motions fitted to two halves of the bone's voxels from different starts: root mean square
        over the bone, largest of six pairs. NaN with "none".
    bone_shift_mm : (3,)
        Displacement of the bone's centroid, LPS.
    """

    motion: RigidMotion
    on: AlignOn
    similarity_before: float
    similarity: float
    repeatability_mm: float
    bone_shift_mm: FloatArray

    def turned(self, rotation: FloatArray) -> Self:
        """The same alignment of two images that are both turned about the world's origin."""
        R, motion = rotation, self.motion
        same = RigidMotion(R @ motion.rotation @ R.T, R @ motion.translation_mm)
        return replace(self, motion=same, bone_shift_mm=R @ self.bone_shift_mm)


def not_aligned(reference: Image, loaded: Image, mask: Mask) -> Alignment:
    """The alignment that leaves both images where their headers put them."""
    similarity = _Likeness(reference, loaded, mask).at(RigidMotion.identity())
    return Alignment(RigidMotion.identity(), "none", similarity, similarity, float("nan"), np.zeros(3))


def refuse_turned_contrast(reference: Image, loaded: Image, tissue: Mask, motion: RigidMotion) -> None:
    """Refuse, by RegistrationError, images of inverted contrast in the tissue, for engines that need one contrast.

    Two images of one contrast correlate locally by more than zero even 15 mm apart (phantoms: 0.03 to 0.84), those
    of inverted contrast by as much below zero.
    """
    _, found = local_correlation(reference, carry(loaded, reference.grid, motion), tissue)
    if found < -_CLEARLY:
        raise RegistrationError(
            f"The images correlate negatively in the tissue (local correlation {found:.2f}) before the non-rigid "
            f"registration: {_OTHER_MEASURE} (--parameters)."
        )


def align(reference: Image, loaded: Image, mask: Mask, on: AlignOn, seed: int) -> Alignment:
    """Find the rigid motion of a mask's voxels, a bone or the whole image, from the reference to the loaded image.

    The images are without bias field (`dvc.images.bias_field`), which would pull the optimum off by some hundredths of
    a millimetre; the seed is that of the halves into which the mask's voxels are divided. InputError if the mask is
    empty, or too little of it is seen in the unloaded image; RegistrationError if no place of the loaded image looks
    like the bone, if the contrast is inverted, or if the fits of two halves disagree by more than 0.5 mm.
    """
    if not mask.inside.any():
        raise InputError(
            "The mask for the rigid alignment is empty. Choose another mask, or align on the image (--align image)."
        )
    fit, likeness = RigidFit(reference, loaded, mask, seed), _Likeness(reference, loaded, mask)
    starts, highest = _search(reference, loaded, mask)
    score, best = _best(fit, likeness, [*starts, RigidMotion.identity()])
    if score < _LOWEST_SIMILARITY:
        raise RegistrationError(_why_failed(reference, loaded, mask, score, highest, on))
    points = mask.points()
    advice = f"so the position of the {on} is uncertain. {_what_to_do(on)}"
    try:
        pairs = fit.halves(best)
    except RegistrationError as why:
        reason = str(why).rstrip(".")
        raise RegistrationError(f"A half of the {on} could not be fitted separately ({reason}), {advice}") from why
    spread = max(apart_mm(one, other, points) for one, other in pairs)
    if not spread <= _LARGEST_SPREAD_MM:
        raise RegistrationError(
            f"Two rigid fits on the {on} differ by {spread:.2f} mm (limit {_LARGEST_SPREAD_MM} mm), {advice}"
        )
    centroid, halves = points.mean(axis=0)[None], [half for pair in pairs for half in pair]
    R = Rotation.from_matrix(np.stack([half.rotation for half in halves])).mean().as_matrix()
    motion = RigidMotion(R, np.mean([half.apply(centroid)[0] for half in halves], axis=0) - R @ centroid[0])
    before, after = likeness.at(RigidMotion.identity()), likeness.at(motion)
    return Alignment(motion, on, before, after, spread, motion.displacement(centroid)[0])


def motion_of(deformation: Deformation, mask: Mask) -> RigidMotion:
    """The rigid motion closest, by least squares, to a deformation of a mask's voxels; InputError if it misses them."""
    X = mask.points()
    x = X + deformation.displacement(X)
    known = np.isfinite(x).all(axis=1)
    if np.count_nonzero(known) < 4:
        raise InputError("The deformation is not defined in the bone, so the bone's motion cannot be removed.")
    X, x = X[known], x[known]
    rotation, _ = Rotation.align_vectors(x - x.mean(axis=0), X - X.mean(axis=0))
    R = rotation.as_matrix()
    return RigidMotion(R, x.mean(axis=0) - R @ X.mean(axis=0))


def without_motion(whole: Deformation, bone: Mask | None) -> tuple[Deformation, RigidMotion]:
    """A deformation without the rigid motion of a mask's voxels (`motion_of`), and that motion; whole without one."""
    if bone is None:
        return whole, RigidMotion.identity()
    motion = motion_of(whole, bone)
    return Composed([whole, motion.inverse()]), motion


def _best(fit: RigidFit, likeness: "_Likeness", starts: Sequence[RigidMotion]) -> tuple[float, RigidMotion]:
    """The most similar place to which fits from ``starts`` lead, as soon as one is certain; and its similarity."""
    score, best = -np.inf, RigidMotion.identity()
    for start in starts:
        try:
            motion = fit.whole(start)
        except RegistrationError:
            continue  # not the place
        if (similarity := likeness.at(motion)) > score:
            score, best = similarity, motion
        if score >= _CERTAIN_SIMILARITY:
            break  # begun from the best places, no other looks like this
    return score, best


class _Likeness:
    """Normalised correlation of the slightly blurred images in and 2 mm around a mask."""

    def __init__(self, reference: Image, loaded: Image, mask: Mask) -> None:
        wide = widened(mask, _SCORE_MARGIN_MM)
        reach = int(np.ceil(_BLUR_REACH * _SCORE_BLUR_MM / mask.grid.spacing_mm.min()))
        box = wide.box(reach)
        part = Image(reference.grid.part(box), reference.values[box])
        self._grid, self._where = part.grid, wide.inside[box]
        self._fixed = smoothed(part, _SCORE_BLUR_MM).values[self._where]
        self._loaded = Carrier(smoothed(loaded, _SCORE_BLUR_MM), order=1)

    def at(self, motion: RigidMotion) -> float:
        """The correlation after a motion; NaN without overlap."""
        moved = self._loaded.onto(self._grid, motion, self._where)[self._where]
        known = np.isfinite(moved) & np.isfinite(self._fixed)
        if np.count_nonzero(known) < 0.5 * known.size:
            return float("nan")
        a, b = self._fixed[known].astype(np.float64), moved[known].astype(np.float64)
        a, b = a - a.mean(), b - b.mean()
        norm = np.sqrt((a * a).sum() * (b * b).sum())
        return float((a * b).sum() / norm) if norm > 0 else float("nan")


def _why_failed(reference: Image, loaded: Image, mask: Mask, score: float, highest: float, on: AlignOn) -> str:
    tries = _scored(reference, loaded, mask, _rotations()[:_INVERTED_TRIES], sign=-1.0)
    inverted = max((score for score, _ in tries), default=0.0)
    found = "no position in the loaded image matches it"
    if np.isfinite(score):
        found = f"the best correlation around it is {score:.2f}"
    told = f"The rigid alignment on the {on} failed: {found} ({_LOWEST_SIMILARITY} is needed)."
    if inverted > max(_LOWEST_SIMILARITY, highest + _CLEARLY):
        return (
            f"{told} With inverted contrast it is {inverted:.2f}: {_OTHER_MEASURE} and --align none, if the images "
            "share a frame."
        )
    return f"{told} {_what_to_do(on)}"


def _what_to_do(on: AlignOn) -> str:
    """The next step where the alignment on a bone, or on the whole image, was refused."""
    if on == "image":
        return "Give a mask of a bone (--bone) instead, or use --align none, if the images share a frame."
    return (
        "Check that both images show the same body part and all of the bone, and that the mask covers it; or use "
        "--align image or none."
    )


# The search at low resolution.


def _rotations() -> list[FloatArray]:
    """Rotations in steps of 9 degrees up to 27 degrees about any axis, the identity first."""
    steps = np.arange(-_ROTATION_LIMIT_DEG, _ROTATION_LIMIT_DEG + 1e-9, _ROTATION_STEP_DEG)
    vectors = np.array(list(product(steps, repeat=3)))
    angle = np.linalg.norm(vectors, axis=1)
    order = np.argsort(angle, kind="stable")
    kept = vectors[order[angle[order] <= _ROTATION_LIMIT_DEG + 1e-9]]
    return list(Rotation.from_rotvec(np.radians(kept)).as_matrix())


def _search(reference: Image, loaded: Image, mask: Mask) -> tuple[list[RigidMotion], float]:
    """The best few places, far enough apart to be different; and the highest score."""
    scored = sorted(_scored(reference, loaded, mask, _rotations()), key=lambda s: -s[0])
    centre = mask.points().mean(axis=0)[None]
    chosen: list[RigidMotion] = []
    for _, motion in scored:
        if len(chosen) < _CANDIDATES and all(
            np.linalg.norm(motion.apply(centre) - other.apply(centre)) > 2 * _SEARCH_MM
            or motion.after(other.inverse()).angle_deg > 1.5 * _ROTATION_STEP_DEG
            for other in chosen
        ):
            chosen.append(motion)
    return chosen, scored[0][0] if scored else -1.0


def _scored(
    reference: Image, loaded: Image, mask: Mask, rotations: list[FloatArray], sign: float = 1.0
) -> list[tuple[float, RigidMotion]]:
    """For each rotation the best translation and its normalised correlation (times ``sign``)."""
    centre = mask.points().mean(axis=0)
    *template, template_grid = _template(reference, mask, centre)
    low, high = loaded.grid.bounds_mm()
    ni, nj, nk = (int(n) for n in np.maximum(np.ceil((high - low) / _SEARCH_MM) + 1, 2))
    scene_grid = Grid((ni, nj, nk), np.full(3, _SEARCH_MM), low)  # axes L, P, S
    scene = carry(smoothed(loaded, _SEARCH_MM / 2.0), scene_grid, order=1)
    known = np.isfinite(scene)
    # Single precision is enough for values about zero of a standard deviation of one.
    values = np.where(known, scene, np.median(scene[known])).astype(np.float64)
    values = ((values - values.mean()) / (values.std() or 1.0)).astype(np.float32)
    # A shift s of the template wraps round: its centre lies at index s + half of the scene. No centre leaves the scene,
    # so half of the template reaches beyond each end, and both ends may reach into the same margin.
    half = (np.array(template_grid.shape) - 1) // 2
    size = [fft.next_fast_len(int(s + h), real=True) for s, h in zip(scene_grid.shape, half, strict=True)]
    scene_f, square_f, known_f = (fft.rfftn(v, size) for v in (values, values**2, known.astype(np.float32)))
    shifts = np.ix_(*((np.arange(s) - h) % n for s, h, n in zip(scene_grid.shape, half, size, strict=True)))

    def scored(rotation: FloatArray) -> tuple[float, RigidMotion] | None:
        back = RigidMotion.about(centre, rotation.T, np.zeros(3))
        t, w = (np.nan_to_num(image.onto(template_grid, back)) for image in template)
        count = w.sum(dtype=np.float64)
        deviation = t - np.float32((t * w).sum(dtype=np.float64) / count)
        energy = float((w * deviation * deviation).sum(dtype=np.float64))
        detail_f, w_f = (np.conj(fft.rfftn(v, size)) for v in (w * deviation, w))
        cross, mean, square, covered = (
            fft.irfftn(of * by, size)[shifts].astype(np.float64)
            for of, by in ((scene_f, detail_f), (scene_f, w_f), (square_f, w_f), (known_f, w_f))
        )
        variance = np.maximum(square / count - (mean / count) ** 2, _LEAST_VARIANCE)
        score = sign * cross / np.sqrt(energy * count * variance)
        score[covered / count < _LEAST_COVERED] = -np.inf
        best = np.unravel_index(int(np.argmax(score)), score.shape)
        if not np.isfinite(score[best]):
            return None  # nowhere does the loaded image show enough of the mask
        to = scene_grid.points_at(np.array(best, dtype=np.float64))
        return float(score[best]), RigidMotion(rotation, to - rotation @ centre)

    with ThreadPoolExecutor(threads.count()) as pool:
        return [found for found in pool.map(scored, rotations) if found is not None]


def _template(reference: Image, mask: Mask, centre: FloatArray) -> tuple[Carrier, Carrier, Grid]:
    """The reference and its weight around the mask, blurred, and a cubic low-resolution grid centred on the mask."""
    near = Mask(mask.grid, widened(mask, _SEARCH_MARGIN_MM).inside & ~reference.missing)
    reach = float(np.linalg.norm(near.points() - centre, axis=1).max())
    half = int(np.ceil(reach / _SEARCH_MM)) + 1
    grid = Grid((2 * half + 1,) * 3, np.full(3, _SEARCH_MM), centre - half * _SEARCH_MM)
    images = fill_missing(reference), Image(mask.grid, near.inside.astype(np.float32))
    template, weight = (Carrier(smoothed(image, _SEARCH_MM / 2.0), order=1) for image in images)
    return template, weight, grid
