"""Pairs of MR images of a heel, unloaded and under a plate, of which the strain is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from dvc.arrays import FloatArray
from dvc.deformation import RigidMotion
from dvc.errors import InputError
from dvc.image import Grid, Image, LabelMap, Mask
from phantoms.anatomy import FAT_SIGNAL, TISSUES, Heel
from phantoms.motions import EllipsoidUnion, Flow
from phantoms.mri import acquire

_PRESS_MM = 7.5
_SHEAR_MM = 5.0
_CENTRE_MM = np.array([0.0, 0.0, -6.0])
_MARGIN_MM = 4.0
_CHUNK = 300_000


@dataclass(frozen=True, slots=True, eq=False)
class HeelPair:
    """Images of one heel with the truth about what happened between them.

    Parameters
    ----------
    reference : Image
        Unloaded.
    loaded : Image
        Under load, the foot moved: tissue at X lies at ``foot_motion.apply(X + u(X))``.
    repeat : Image
        Unloaded again, the foot moved by the same motion, with other noise and coil sensitivity.
    labels : LabelMap
        Tissues on the reference's grid, by voxel centre.
    bone : Mask
        The calcaneus on the reference's grid.
    deformation : Flow
        u relative to the bone, and its gradient, in the reference's configuration, LPS mm.
    foot_motion : RigidMotion
        From the reference's frame to the loaded and the repeated scan, LPS mm.
    """

    reference: Image
    loaded: Image
    repeat: Image
    labels: LabelMap
    bone: Mask
    deformation: Flow
    foot_motion: RigidMotion


def heel_pair(
    seed: int = 1,
    shape: tuple[int, int, int] = (126, 140, 132),
    spacing_mm: float | Sequence[float] = 0.8,
    snr: float | None = 25.0,
    load: float = 1.0,
    foot_motion: RigidMotion | None = None,
    loaded_grid: Grid | None = None,
) -> HeelPair:
    """Images of a heel without load, under load, and without load again.

    The loaded image is I1(y) = I0(phi^-1(R^T (y - t))), where I0 is the anatomy's closed form: nothing
    that has been sampled is ever resampled. Each image has its own noise and coil sensitivity.

    Parameters
    ----------
    seed : int
        Of shapes, textures, noise and sensitivities; 0 or more.
    shape, spacing_mm
        Of the reference's grid, centred just below the calcaneus's middle. Spacing in mm, one or three.
    snr : float or None
        Fat's signal over the noise's standard deviation; None for no noise.
    load : float
        Factor on the plate's motion; 1 is a press of 7.5 mm with a shear of 5 mm forward.
    foot_motion : RigidMotion
        Of the whole foot between scans; a few degrees and mm by default.
    loaded_grid : Grid
        Of the loaded and repeated image. By default the reference's, extended where the bone would leave it.

    Raises
    ------
    InputError
        If the seed is negative, the load negative or beyond 1.5, or the SNR or the grid out of range.
    """
    if snr is not None and not snr > 0:
        raise InputError(f"The SNR must be positive, or None for an image without noise; got {snr}.")
    if not 0.0 <= load <= 1.5:
        raise InputError(f"The load must lie between 0 and 1.5; got {load}.")
    heel = Heel(seed)
    grid = _centred_grid(shape, spacing_mm)
    motion = default_motion() if foot_motion is None else foot_motion
    flow = pressed(heel, load)
    labels = LabelMap(grid, heel.tissue_at(grid.points().reshape(-1, 3)).reshape(grid.shape), TISSUES)
    bone = labels.region("bone")
    scan = _covering(grid, motion.apply(bone.points())) if loaded_grid is None else loaded_grid

    def scanned(number: int, where: Grid, truth: Flow, moved: RigidMotion) -> Image:
        noise, bias = (int(s) for s in np.random.SeedSequence([seed, 2, number]).generate_state(2))
        signal = loaded_octants(heel, truth, moved, where)
        return acquire(signal, where, snr=snr, reference_signal=FAT_SIGNAL, seed=noise, bias_seed=bias)

    still = pressed(heel, 0.0)
    return HeelPair(
        reference=scanned(0, grid, still, RigidMotion.identity()),
        loaded=scanned(1, scan, flow, motion),
        repeat=scanned(2, scan, still, motion),
        labels=labels,
        bone=bone,
        deformation=flow,
        foot_motion=motion,
    )


def default_motion() -> RigidMotion:
    """Return the foot's motion between scans when none is asked for: 3.7 degrees, 2.9 mm."""
    turn = Rotation.from_rotvec([2.5, -1.5, 2.2], degrees=True).as_matrix()
    return RigidMotion.about(np.array([0.0, 5.0, 0.0]), turn, np.array([1.6, -2.0, 1.4]))


def pressed(heel: Heel, load: float = 1.0) -> Flow:
    """Return the flow of a heel under a plate moving up and forward, its bones at rest; load scales it."""
    bones = heel.skeleton
    return Flow(
        load * np.array([0.0, -_SHEAR_MM, _PRESS_MM]),
        pivot_mm=np.array([0.0, 15.0, -47.0]),
        # merged softly, which makes the body larger: the bones stay inside, and motion rises around them smoothly
        rest=EllipsoidUnion(bones.centres_mm, bones.forms, sharpness=1.25),
        ramp=1.0,
        centre_mm=np.array([0.0, 14.0, -50.0]),
        width_mm=np.array([51.0, 58.0, 31.0]),
    )


def loaded_signal(heel: Heel, flow: Flow, motion: RigidMotion) -> Callable[[FloatArray], FloatArray]:
    """Noise-free signal of the heel after the flow and then the motion, as a function of points (n, 3) mm."""
    back, home = flow.inverse(), motion.inverse()

    def signal(points_mm: FloatArray) -> FloatArray:
        x = home.apply(points_mm)
        return heel.intensity_at(x + back.displacement(x))

    return signal


def _centred_grid(shape: tuple[int, int, int], spacing_mm: float | Sequence[float]) -> Grid:
    spacing = np.asarray(spacing_mm, dtype=np.float64)
    if spacing.shape not in {(), (3,)}:
        raise InputError(f"Voxel spacing must be one length or three, mm; got {spacing_mm}.")
    spacing = np.broadcast_to(spacing, (3,))
    return Grid(shape, spacing, _CENTRE_MM - 0.5 * (np.array(shape) - 1) * spacing)


def _covering(grid: Grid, points_mm: FloatArray) -> Grid:
    """Return the grid, extended by whole voxels where points come closer than a margin to its border."""
    if len(points_mm) == 0:
        return grid
    indices = grid.indices_of(points_mm)
    margin = np.ceil(_MARGIN_MM / np.asarray(grid.spacing_mm))
    before = np.maximum(0, np.ceil(margin - indices.min(axis=0))).astype(int)
    after = np.maximum(0, np.ceil(indices.max(axis=0) + margin - (np.array(grid.shape) - 1))).astype(int)
    i, j, k = (int(n) for n in np.array(grid.shape) + before + after)
    return Grid((i, j, k), grid.spacing_mm, grid.points_at(-before.astype(np.float64)), grid.direction)


def loaded_octants(heel: Heel, flow: Flow, motion: RigidMotion, grid: Grid) -> FloatArray:
    """The heel's signal in the octants of a grid's voxels, (ni, nj, nk, 2, 2, 2), after flow and rigid motion.

    Each voxel's centre is carried back exactly; its octants are spread along the edges that the voxel has
    there, which to first order are columns of F^-1 R^T times the spacing.
    """
    back, home = flow.inverse(), motion.inverse()
    edges = home.rotation @ (np.asarray(grid.direction) * grid.spacing_mm)
    centres = home.apply(grid.points().reshape(-1, 3))
    out = np.zeros((len(centres), 2, 2, 2))
    # further out all is air, before and after: no tissue moves by 1.2 times the plate's displacement
    reach = 1.2 * float(np.linalg.norm(flow.plate_mm)) + 2.0
    near = np.flatnonzero(heel.outline.distance(centres) < reach)
    for start in range(0, len(near), _CHUNK):
        some = near[start : start + _CHUNK]
        X = centres[some]
        u, H = back.evaluate(X)
        out[some] = heel.octant_intensity(X + u, (H + np.eye(3)) @ edges)
    return out.reshape(*grid.shape, 2, 2, 2)
