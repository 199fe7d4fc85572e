"""A heel under a plate: its motions under Load1 to Load4, and its MR images, with exactly known strain."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial.transform import Rotation

from dvc import Composed, Grid, Image, LabelMap, Mask, RigidMotion
from dvc.arguments import checked
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.protocol import Motion
from dvc.errors import InputError
from phantoms.anatomy import FAT_SIGNAL, TISSUES, Heel
from phantoms.bodies import EllipsoidUnion
from phantoms.flow import Border, Flow
from phantoms.motions import ShearWave
from phantoms.mri import acquire, sampled_by

LOADS: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {"Load1": (6.0, 0.0, 3.0), "Load2": (1.4, 0.0, 0.7), "Load3": (1.4, 4.2, 4.5), "Load4": (1.4, 1.5, 1.5)}
)
"""Indentation and shear displacement of the plate, and sliding of the pad inside its skin, of each load; mm at size 1.

Chosen for the max. shear of finite-element models of the heel under 140 N, 15 N, 15 + 45 N and 15 + 12 N: a median and
90th percentile of about .20 / .40, .05 / .09, .13 / .35, .06 / .13 in the fat around the calcaneus.
"""

_PRESS_MM, _SHEAR_MM, _SLIDE = 7.5, 5.0, 0.1
_WAVE_PEAK = 0.2
_CENTRE_MM = np.array([0.0, 0.0, -6.0])
_CONTACT_MM = (0.0, 15.0, -47.0)  # of the plate and the sole, at size 1
_WHOLE_SOLE = (0.0, 14.0, -50.0), (51.0, 58.0, 31.0)  # window: centre and width, mm at size 1
_MARGIN_MM = 4.0
_FIELD_MM = (100.8, 112.0, 105.6)
_FINEST_MM, _COARSEST_MM, _LARGEST = 0.3, 4.0, 512
_CHUNK, _COARSE = 300_000, 4
_STIFF = ("bone", "ankle", "skin")
_Triple = tuple[float, float, float]
_Window = tuple[_Triple, _Triple]


@dataclass(frozen=True, slots=True, eq=False)
class HeelPair:
    """Images of one heel and the true motion between them.

    Parameters
    ----------
    reference, loaded, repeat : Image
        Unloaded; under load, where tissue at X lies at ``foot_motion.apply(X + u(X))``; and unloaded again after the
        same rigid motion, with its own noise and bias field.
    labels : LabelMap
        Tissue at each voxel centre of the reference.
    bone : Mask
        The calcaneus, on the reference grid.
    deformation : Motion
        u relative to the bone and its gradient, reference configuration, LPS mm.
    foot_motion : RigidMotion
        Rigid motion of the foot from the reference to the other two scans, LPS mm.
    """

    reference: Image
    loaded: Image
    repeat: Image
    labels: LabelMap
    bone: Mask
    deformation: Motion = field(repr=False)
    foot_motion: RigidMotion


@checked
def heel_pair(
    seed: int = 1, shape: tuple[int, int, int] = (126, 140, 132), spacing_mm: float | Sequence[float] = 0.8,
    snr: float | None = 25.0, load: float = 1.0, motion: Motion | None = None, foot_motion: RigidMotion | None = None,
    loaded_grid: Grid | None = None,
) -> HeelPair:  # fmt: skip
    """Images of a heel: unloaded, loaded, and unloaded again.

    Parameters
    ----------
    seed : int
        Seed of shapes, textures, noise and bias fields; 0 or more.
    shape, spacing_mm
        Voxels along each axis, and voxel size in mm (one or three), of a grid centred just below the middle of the
        calcaneus. Neither follows from the other: a heel in larger voxels needs fewer, ``heel_grid(1.6).shape``.
    snr
        As in `scan`.
    load : float
        Factor on the plate displacement; 1 is an indentation of 7.5 mm with a forward shear of 5 mm.
    motion : Motion, optional
        Motion of tissue relative to bone in place of that smooth load, for the heel of this seed.
    foot_motion : RigidMotion, optional
        Rigid motion of the foot between scans; a few degrees and mm by default.
    loaded_grid : Grid, optional
        Grid of the loaded and the repeat image; by default that of the reference, extended where the bone would leave
        it.

    Returns
    -------
    HeelPair
        ``reference``, ``loaded`` and ``repeat`` images; ``labels`` and ``bone`` on the reference grid; and the truth:
        ``deformation`` (relative to the bone, reference configuration) and ``foot_motion``, LPS mm.

    Raises
    ------
    InputError
        If the seed is negative, the load is outside 0 to 1.5, or the SNR or the grid is out of range.
    """
    if not 0.0 <= load <= 1.5:
        raise InputError(f"The load must be between 0 and 1.5; got {load}.")
    heel, grid = Heel(seed), centred_grid(shape, spacing_mm)
    foot = foot_motion or default_foot_motion()
    flow = pressed(heel, load) if motion is None else motion
    labels = labels_of(heel, grid)
    bone = labels.region("bone")
    where = covering(grid, foot.apply(bone.points())) if loaded_grid is None else loaded_grid
    reference = scan(heel, grid, snr=snr, number=0)
    loaded = scan(heel, where, flow, foot, snr=snr, number=1)
    repeat = scan(heel, where, None, foot, snr=snr, number=2)
    return HeelPair(reference, loaded, repeat, labels, bone, flow, foot)


@checked
def scan(
    heel: Heel, grid: Grid, motion: Motion | None = None, foot_motion: RigidMotion | None = None, *, snr: float | None,
    number: int,
) -> Image:  # fmt: skip
    """MR image of a heel on a grid (LPS mm) after a motion of its tissue, followed by a rigid motion of the foot.

    I(y) = I0(phi^-1(R^T (y - t))), where I0 is the closed form of the anatomy, so that no sampled image is ever
    resampled.

    Parameters
    ----------
    motion : Motion, optional
        Motion of tissue relative to bone; none for an unloaded heel.
    snr : float or None
        Signal of fat over the standard deviation of the noise; None for an image without noise.
    number : int
        Acquisition number; together with the heel's seed it determines noise and bias field.

    Raises
    ------
    InputError
        If the SNR is out of range.
    """
    noise, bias = (int(s) for s in np.random.SeedSequence([heel.seed, 2, number]).generate_state(2))
    signal = octants(heel, sampled_by(grid), motion, foot_motion or RigidMotion.identity())
    return acquire(signal, grid, snr=snr, reference_signal=FAT_SIGNAL, seed=noise, bias_seed=bias)


def labels_of(heel: Heel, grid: Grid) -> LabelMap:
    """Tissue (a key of `TISSUES`; 0 is air) of an unloaded heel at each voxel centre of a grid, LPS mm."""
    return LabelMap(grid, heel.tissue_at(grid.points().reshape(-1, 3)).reshape(grid.shape), TISSUES)


def misdrawn(labels: LabelMap, voxels: int) -> LabelMap:
    """Return a label map with bones and skin too large by a number of voxels or, below zero, too small.

    They grow into the adjacent softer tissue, or it into them; the outline of the body is unchanged.
    """
    stiff = np.isin(labels.labels, [number for number, name in labels.names.items() if name in _STIFF])
    soft = (labels.labels > 0) & ~stiff
    growing, shrinking = (stiff, soft) if voxels > 0 else (soft, stiff)
    changed = binary_dilation(growing, iterations=abs(voxels)) & shrinking if voxels else np.zeros_like(stiff)
    nearest = distance_transform_edt(~growing, return_distances=False, return_indices=True)
    return LabelMap(labels.grid, np.where(changed, labels.labels[tuple(nearest)], labels.labels), labels.names)


def labels_to_mesh(heel: Heel, labels: LabelMap) -> LabelMap:
    """Part of a label map for a finite-element model: sole and heel, 75 to 100 mL of soft tissue at size 1, and bone.

    The truncation surfaces are a horizontal plane through the middle of the calcaneus and a vertical one at its front;
    beyond them labels are 0.
    """
    points = labels.grid.points()
    kept = (points[..., 2] < 0.0) & (points[..., 1] > -20.0 * heel.size)
    return LabelMap(labels.grid, np.where(kept, labels.labels, 0), labels.names)


def random_foot_motion(seed: int, number: int) -> RigidMotion:
    """Draw the rigid motion of the foot before an acquisition, LPS mm; equal seeds and numbers give equal motions.

    Up to 3 degrees about each axis through (0, 5, 0) mm, and up to 2 mm along it.
    """
    random = np.random.default_rng([seed, 3, number])
    return _foot_motion(random.uniform(-3.0, 3.0, 3), random.uniform(-2.0, 2.0, 3))


def default_foot_motion() -> RigidMotion:
    """Return the default rigid motion of the foot between scans, LPS: 3.7 degrees about (0, 5, 0) mm and 2.9 mm."""
    return _foot_motion(np.array([2.5, -1.5, 2.2]), np.array([1.6, -2.0, 1.4]))


def _foot_motion(turn_deg: FloatArray, shift_mm: FloatArray) -> RigidMotion:
    turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    return RigidMotion.about(np.array([0.0, 5.0, 0.0]), turn, shift_mm)


def pressed(heel: Heel, load: float = 1.0) -> Flow:
    """Return the flow of `under_plate` for a plate that moves up 7.5 mm and forward 5 mm, times ``load``."""
    return under_plate(heel, press_mm=load * _PRESS_MM, shear_mm=load * _SHEAR_MM)


def under_plate(heel: Heel, *, press_mm: float, shear_mm: float) -> Flow:
    """Return the isochoric flow of a heel under a plate that moves up by ``press_mm`` and forward by ``shear_mm``.

    Its bones are constrained. Both displacements are those of a heel of size 1 and scale with the heel.
    """
    steps = max(3, int(np.ceil(1.1 * np.hypot(press_mm, shear_mm))))
    return _flow(heel, (0.0, -shear_mm, press_mm), _CONTACT_MM, _around_bones(heel), _WHOLE_SOLE, steps=steps)


def _flow(heel: Heel, plate: _Triple, pivot: _Triple, rest: Border, window: _Window, **more: Any) -> Flow:
    """Flow whose plate displacement, pivot, and window (centre and width), mm, are those of a heel of size 1."""
    plate_mm, pivot_mm, centre_mm, width_mm = (heel.size * np.array(at) for at in (plate, pivot, *window))
    return Flow(plate_mm, pivot_mm, rest, centre_mm, width_mm, **more)


def _around_bones(heel: Heel) -> Border:
    """Constrained bones; their soft union is larger than they are, and the motion rises smoothly around it."""
    bones = heel.skeleton
    return Border(EllipsoidUnion(bones.centres_mm, bones.forms, sharpness=1.25), ramp=1.0)


def sliding(heel: Heel, shear_mm: float) -> Flow:
    """Return the flow of the heel pad between constrained bone and constrained skin.

    Strain is discontinuous at both interfaces: fat is sheared right up to them. ``shear_mm`` is roughly the
    displacement in the middle of the pad of a heel of size 1, and scales with the heel.
    """
    # The pivot is far above the pad, where the potential is then nearly uniform, so that tissue circulates around it.
    pivot, window = (0.0, 14.0, 50.0), ((1.0, 15.0, -32.0), (22.0, 26.0, 17.0))
    rest, skin = Border(heel.skeleton, ramp=0.6, order=2), Border(heel.flesh, ramp=0.2, order=2)
    steps = max(3, int(np.ceil(1.25 * shear_mm)))
    return _flow(heel, (0.0, _SLIDE * shear_mm, 0.0), pivot, rest, window, skin=skin, steps=steps)


def attached(heel: Heel, *, press_mm: float, shear_mm: float) -> Flow:
    """Return the isochoric flow of tissue that is attached to bone, under a plate that moves as in `under_plate`.

    Strain is largest at the surface of the bones, which do not move, and falls off over about 5 mm: the concentration
    at bone of finite-element models of the heel. ``press_mm`` and ``shear_mm`` are those of a heel of size 1.
    """
    steps = max(6, int(np.ceil(1.8 * np.hypot(press_mm, shear_mm))))
    plate, rest = (0.0, -shear_mm, press_mm), Border(heel.skeleton, ramp=0.6, order=2)
    return _flow(heel, plate, _CONTACT_MM, rest, _WHOLE_SOLE, steps=steps)


def swelling(heel: Heel) -> Flow:
    """Return a flow of the heel pad that changes its volume: det F from about 0.91 to 1.17, smoothly over 20 to 40 mm.

    Bones are constrained, and volume does not change in or at them. Tissue below the calcaneus is carried forward and
    slightly down, which compresses the tissue in front of it and expands that behind and above it.
    """
    window = (0.0, 8.0, -40.0), (15.0, 14.0, 15.0)
    return _flow(heel, (0.0, -2.4, -0.8), _CONTACT_MM, _around_bones(heel), window, keeps_volume=False)


@checked
def under_load(heel: Heel, load: str) -> Motion:
    """Isochoric motion of a heel under one of `LOADS`: the pad slides inside its skin, then the plate moves all tissue.

    u is relative to bone, LPS mm, reference configuration; InputError for another load.
    """
    if load not in LOADS:
        raise InputError(f"Unknown load '{load}'; choose one of {', '.join(LOADS)}.")
    press, shear, slide = LOADS[load]
    return Composed([sliding(heel, slide), under_plate(heel, press_mm=press, shear_mm=shear)])


_MOTIONS: Mapping[str, Callable[[Heel], Motion | None]] = {
    "still": lambda _: None,
    "smooth": pressed,
    "sliding": partial(sliding, shear_mm=4.0),
    "swelling": swelling,
    **{load: partial(under_load, load=load) for load in LOADS},
    "attached-Load1": partial(attached, press_mm=4.5, shear_mm=1.5),
    "attached-Load3": partial(attached, press_mm=1.2, shear_mm=2.8),
}


def motion_named(heel: Heel, name: str) -> Motion | None:
    """Motion of a heel's tissue by its name (see `AccuracyCase`), LPS mm, reference configuration; None for "still".

    InputError for an unknown name, or a wave whose length is not positive.
    """
    if name in _MOTIONS:
        return _MOTIONS[name](heel)
    wavelength = wavelength_of(name)
    if wavelength is None:
        raise InputError(f"Unknown motion '{name}'; choose one of {', '.join(_MOTIONS)} or wave-L (L in mm).")
    # Along the foot, varying across the pad's thickness; each heel has a phase of its own.
    phase = float(np.random.default_rng([heel.seed, 4]).uniform(0.0, 2.0 * np.pi))
    return ShearWave(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), wavelength, _WAVE_PEAK, phase)


def wavelength_of(motion: str) -> float | None:
    """L, mm, of a motion named wave-L, NaN where that is no number; None for another motion."""
    if not motion.startswith("wave-"):
        return None
    try:
        return float(motion.removeprefix("wave-"))
    except ValueError:
        return float("nan")


def octants(heel: Heel, grid: Grid, motion: Motion | None, foot_motion: RigidMotion) -> FloatArray:
    """Signal of the heel in the octants of a grid's voxels, (ni, nj, nk, 2, 2, 2), after both motions.

    The centre of each voxel is mapped back exactly. Its octants are placed along the mapped edges of the voxel, to
    first order the columns of F^-1 R^T times the spacing.
    """
    home = foot_motion.inverse()
    edges = home.rotation @ (np.asarray(grid.direction) * grid.spacing_mm)
    centres = home.apply(grid.points().reshape(-1, 3))
    out = np.zeros((len(centres), 2, 2, 2))
    back = None if motion is None else motion.inverse()
    near = np.flatnonzero(_may_show(heel, grid, back, home).ravel())
    for start in range(0, len(near), _CHUNK):
        some = near[start : start + _CHUNK]
        x = centres[some]
        if back is None:
            out[some] = heel.octant_intensity(x, edges)
        else:
            u, H = back.evaluate(x)
            out[some] = heel.octant_intensity(x + u, (H + np.eye(3)) @ edges)
    return out.reshape(*grid.shape, 2, 2, 2)


def _may_show(heel: Heel, grid: Grid, back: Motion | None, home: RigidMotion) -> BoolArray:
    """Voxels (ni, nj, nk) that may show tissue, judged on every fourth of the grid's planes along each axis."""
    planes = [np.arange(0, n + _COARSE - 1, _COARSE) for n in grid.shape]
    corners = home.apply(grid.points_at(np.stack(np.meshgrid(*planes, indexing="ij"), axis=-1).astype(np.float64)))
    x = corners.reshape(-1, 3)
    at = x if back is None else x + back.displacement(x)
    # A voxel is within half a cell diagonal of the nearest corner; a factor of two allows for stretch.
    diagonal = _COARSE * float(np.linalg.norm(grid.spacing_mm))
    shown = (heel.outline.distance(at) < diagonal + 1.0).reshape([len(p) for p in planes])
    for axis, n in enumerate(grid.shape):
        shown = np.repeat(shown, _COARSE, axis=axis).take(np.arange(_COARSE // 2, n + _COARSE // 2), axis=axis)
    return np.asarray(shown)


def centred_grid(shape: tuple[int, int, int], spacing_mm: float | Sequence[float]) -> Grid:
    """Grid of so many voxels along LPS x, y and z, centred 6 mm below the middle of the calcaneus of a heel of size 1.

    InputError unless ``spacing_mm`` is one length or three between 0.05 and 20 mm.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    if spacing.shape not in {(), (3,)} or not ((spacing >= 0.05) & (spacing <= 20.0)).all():
        raise InputError(f"Voxel spacing must be one length or three between 0.05 and 20 mm; got {spacing_mm}.")
    return Grid(shape, np.broadcast_to(spacing, 3), _CENTRE_MM - 0.5 * (np.array(shape) - 1) * spacing)


def heel_grid(spacing_mm: float | Sequence[float], size: float = 1.0) -> Grid:
    """Grid that covers a heel of the given size, 101 x 112 x 106 mm at size 1.

    Raises
    ------
    InputError
        If the spacing is not one or three lengths between 0.3 and 4 mm, or needs more than 512 voxels along an axis.
    """
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    if spacing.shape not in {(), (3,)} or not ((spacing >= _FINEST_MM) & (spacing <= _COARSEST_MM)).all():
        raise InputError(
            f"Voxel spacing must be one length or three between {_FINEST_MM} and {_COARSEST_MM} mm; got {spacing_mm}."
        )
    i, j, k = (int(n) for n in np.round(size * np.array(_FIELD_MM) / np.broadcast_to(spacing, 3)))
    if max(i, j, k) > _LARGEST:
        raise InputError(
            f"A heel of size {size} at {spacing_mm} mm needs {i} x {j} x {k} voxels; the limit is {_LARGEST} along an "
            "axis. Choose larger voxels."
        )
    return centred_grid((i, j, k), spacing_mm)


def covering(grid: Grid, points_mm: FloatArray) -> Grid:
    """Return the grid, extended by whole voxels where points (n, 3) LPS mm come closer than 4 mm to its border."""
    if len(points_mm) == 0:
        return grid
    indices = grid.indices_of(points_mm)
    margin = np.ceil(_MARGIN_MM / np.asarray(grid.spacing_mm))
    before = np.maximum(0, np.ceil(margin - indices.min(axis=0))).astype(int)
    after = np.maximum(0, np.ceil(indices.max(axis=0) + margin - (np.array(grid.shape) - 1))).astype(int)
    i, j, k = (int(n) for n in np.array(grid.shape) + before + after)
    return Grid((i, j, k), grid.spacing_mm, grid.points_at(-before.astype(np.float64)), grid.direction)
