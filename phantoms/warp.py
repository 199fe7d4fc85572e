"""Synthetic warp of a subject's own unloaded image: the image that a given deformation would have produced.

A registration would follow noise that is moved with the tissue like texture, so it is removed first and drawn anew.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, map_coordinates, spline_filter
from scipy.spatial import cKDTree
from skimage.restoration import denoise_nl_means

from dvc import Deformation, Grid, Image, Mask, RigidMotion, evaluate_on_grid
from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.deformation.protocol import Motion
from dvc.errors import InputError
from dvc.images.noise import noise_sd
from dvc.images.resample import fill_missing
from phantoms.mri import rician, sensitivity

_TOLERANCE_MM, _ROUNDS = 1e-7, 60
_MARGIN_MM, _RIM_VOXELS = 12.0, 2
_CHUNK, _FEW = 200_000, 1000


@dataclass(frozen=True, slots=True)
class Acquisition:
    """How a warped image is acquired.

    Parameters
    ----------
    seed : int
        Of noise and bias field.
    grid : Grid, optional
        Grid of the warped image, LPS mm; by default that of the unloaded image.
    bias_field : bool
        Whether the image has a receive field of its own, between 0.8 and 1.2.
    noise_factor : float
        Noise of the warped image, relative to that of the unloaded one.
    """

    seed: int
    grid: Grid | None = None
    bias_field: bool = True
    noise_factor: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticWarp:
    """A warped image, the SD of its noise (in its grey values), and the fraction of the tissue known and in view."""

    image: Image
    noise_sd: float
    shown: float


def synthetic_warp(
    reference: Image, tissue: Mask, motion: Deformation, acquisition: Acquisition, *, near: RigidMotion | None = None,
    beyond_missing: bool = False,
) -> SyntheticWarp:  # fmt: skip
    """Form the image of a subject's tissue after a deformation.

    I1(x) = D(phi^-1(x)) b(x) with Rician noise, where D is the denoised unloaded image (non-local means), interpolated
    by cubic splines, and b a smooth receive field. Outside the deformed tissue the image shows air.

    Parameters
    ----------
    reference : Image
        Unloaded.
    tissue : Mask
        The body, bone included, on the unloaded image's grid; the warped image shows nothing else.
    motion : Deformation
        The total motion phi, rigid motion of the foot included: X to X + u(X), LPS mm, reference configuration.
    near : RigidMotion, optional
        A rigid motion close to the total one, that of the bone: tissue is looked for within 30 mm of where it places
        it.
    beyond_missing : bool
        Whether voxels that come from outside the unloaded field of view (under ``near``) are NaN instead of air: the
        body continues beyond the image, and a registration would follow a truncation surface that moves.

    Raises
    ------
    InputError
        If the mask does not fit the image, or the deformation folds, is undefined in half of the tissue, or moves the
        tissue out of the image.

    Notes
    -----
    Compared with an image of the true anatomy, denoising removes some fine texture, noise that it leaves
    moves with the tissue, and partial volume at interfaces is that of the unloaded image, blurred once more by
    interpolation. The first makes a registration look worse, the second better. On a phantom at SNR 25 and 0.8 mm, 0.42
    of the noise amplitude remained and 0.18 of the finest texture was lost; the error of the maximum shear strain was
    1.2 times as large in fat, 1.5 times in muscle and 2.5 times in bone (benchmarks/README.md).

    References
    ----------
    Buades, Coll and Morel, CVPR 2005, doi:10.1109/CVPR.2005.38 (non-local means).
    """
    if not tissue.grid.same_as(reference.grid) or not tissue.inside.any():
        raise InputError("The tissue mask is empty, or on another grid than the unloaded image. Give another mask.")
    grid, near = acquisition.grid or reference.grid, near or RigidMotion.identity()
    shown = _shown(tissue, motion, grid)
    sigma = noise_sd(reference, tissue)
    # With the rim of air around it the skin keeps its partial volume, wherever the deformation is defined there.
    drawn = Mask(tissue.grid, binary_dilation(tissue.inside, iterations=_RIM_VOXELS))
    values = _warped(_denoised(reference, tissue, sigma), drawn, motion, near, grid)
    if acquisition.bias_field:
        values *= sensitivity(grid, acquisition.seed + 1)
    noise = acquisition.noise_factor * sigma
    values = rician(values, noise, acquisition.seed)
    if beyond_missing:
        came_from = near.inverse().apply(grid.points().reshape(-1, 3))
        values[~reference.grid.contains(came_from).reshape(grid.shape)] = np.nan
    return SyntheticWarp(Image(grid, values), float(np.float32(noise)), shown)


def _shown(tissue: Mask, motion: Deformation, grid: Grid) -> float:
    """Fraction of the tissue that a motion leaves in view; a motion that no image can show is refused."""
    u, H = evaluate_on_grid(motion, tissue.grid, tissue.inside)
    points = tissue.points()
    known: BoolArray = np.all(np.isfinite(H), axis=(1, 2)) & np.all(np.isfinite(u), axis=1)
    if np.count_nonzero(known) < 0.5 * len(known):
        share = f"{100 * known.mean():.0f} %"
        raise InputError(f"The deformation is defined in only {share} of the tissue; 50 % is needed.")
    folded = np.flatnonzero(known)[np.linalg.det(H[known] + np.eye(3)) <= 0.0]
    if len(folded):
        at = points[folded[0]]
        raise InputError(
            f"The deformation folds (det F <= 0) in {len(folded)} voxels of the tissue, such as at LPS "
            f"({at[0]:.1f}, {at[1]:.1f}, {at[2]:.1f}) mm. An image cannot be warped by it."
        )
    moved = points + u
    shown = np.count_nonzero(grid.contains(moved[np.isfinite(moved).all(axis=1)])) / len(points)
    if shown < 0.5:
        raise InputError(
            f"The deformation moves {100 * (1 - shown):.0f} % of the tissue out of the field of view, or is not "
            "defined there. Pass a deformation of this image that includes the bone motion, or a smaller tissue mask."
        )
    return shown


def material_points(motion: Deformation, points_mm: FloatArray, start_mm: FloatArray) -> FloatArray:
    """Material points X (n, 3) LPS mm that a deformation moves to the points x (n, 3) LPS mm; NaN where none is found.

    Newton's method on X + u(X) = x from ``start_mm`` (n, 3). The result is NaN where it leaves the domain of the
    deformation or does not converge to within 1e-7 mm.
    """
    X = np.asarray(start_mm, dtype=np.float64)
    active = np.arange(len(X))
    solution = np.full(X.shape, np.nan)
    for _ in range(_ROUNDS):
        u, H = motion.evaluate(X)
        residual = points_mm[active] - X - u
        size = np.linalg.norm(residual, axis=1)
        done = size < _TOLERANCE_MM
        solution[active[done]] = X[done]
        kept = np.isfinite(size) & ~done & np.isfinite(H).all(axis=(1, 2))
        if not kept.any():
            break
        active, X, residual, H = active[kept], X[kept], residual[kept], H[kept]
        F = H + np.eye(3)
        determinant = np.linalg.det(F)
        newton = np.linalg.solve(F + 1e-9 * np.eye(3), residual[..., None])[..., 0]
        step = np.where((determinant > 1e-3)[:, None], newton, 0.5 * residual)
        # a long step may leave the region where the map is close to linear
        X = X + step * np.minimum(1.0, 4.0 / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
    return solution


def _denoised(image: Image, tissue: Mask, sigma: float) -> Image:
    """The image without noise, within the bounding box of the tissue and a margin."""
    box = tissue.box(int(np.ceil(_MARGIN_MM / image.grid.spacing_mm.min())))
    values = fill_missing(image).values[box].astype(np.float32)
    if sigma > 0:
        values = denoise_nl_means(
            values, patch_size=3, patch_distance=4, h=sigma, sigma=sigma, fast_mode=True, preserve_range=True
        )
        # Rician bias: E[m]^2 is about s^2 + sigma^2 where the signal is well above the noise.
        values = np.sqrt(np.maximum(values**2 - sigma**2, 0.0))
    return Image(image.grid.part(box), values.astype(np.float32))


def _warped(clean: Image, tissue: Mask, motion: Deformation, near: RigidMotion, grid: Grid) -> Float32Array:
    """The clean image at the material points of a grid's voxels, (ni, nj, nk); zero outside the tissue."""
    coefficients = spline_filter(clean.values.astype(np.float64), order=3, mode="mirror")
    back = None
    if isinstance(motion, Motion):
        with suppress(InputError):  # a composition with a part that has no closed inverse
            back = motion.inverse()
    # Newton's method starts at the voxel whose deformed position is nearest; one voxel in eight is close enough.
    thin = np.zeros_like(tissue.inside)
    thin[::2, ::2, ::2] = tissue.inside[::2, ::2, ::2]
    home = tissue.grid.points(thin if np.count_nonzero(thin) >= _FEW else tissue.inside)
    there = home + motion.displacement(home)
    known = np.all(np.isfinite(there), axis=1)
    home, moved = home[known], cKDTree(there[known])
    out = np.zeros(int(np.prod(grid.shape)), dtype=np.float32)
    x = grid.points().reshape(-1, 3)
    X, body = near.inverse().apply(x), tissue.points()
    # Tissue is looked for within 30 mm of its bounding box, moved rigidly.
    where = np.flatnonzero(((body.min(axis=0) - 30.0 <= X) & (body.max(axis=0) + 30.0 >= X)).all(axis=1))
    for start in range(0, len(where), _CHUNK):
        some = where[start : start + _CHUNK]
        if back is not None:
            X = x[some] + back.displacement(x[some])
        else:
            X = material_points(motion, x[some], home[moved.query(x[some])[1]])
        inside = np.flatnonzero(np.isfinite(X).all(axis=1))
        inside = inside[_in_mask(tissue, X[inside])]
        at = clean.grid.indices_of(X[inside]).T
        out[some[inside]] = map_coordinates(coefficients, at, order=3, mode="mirror", prefilter=False)
    return np.maximum(out, 0.0).reshape(grid.shape)


def _in_mask(tissue: Mask, points_mm: FloatArray) -> BoolArray:
    """Which points (n, 3) lie in the mask, by nearest voxel."""
    at = np.rint(tissue.grid.indices_of(points_mm)).astype(np.int64)
    shape = np.array(tissue.grid.shape)
    held = tissue.inside[tuple(np.clip(at, 0, shape - 1).T)]
    return np.asarray(held & np.all((at >= 0) & (at < shape), axis=1))
