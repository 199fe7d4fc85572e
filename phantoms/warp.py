"""A loaded twin of somebody's own unloaded image: the image that any deformation would have made of it.

What is known of an own image is its voxels, noise and all. Carried through a deformation as they are, noise would move
with the tissue, and a registration would follow it as if it were texture. So the noise is taken out before, and drawn
anew after. What that costs is told at `synthetic_warp`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, map_coordinates, spline_filter
from scipy.spatial import cKDTree
from skimage.restoration import denoise_nl_means

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.deformation.protocol import Deformation, Motion, RigidMotion, evaluate_on_grid
from dvc.errors import InputError
from dvc.images.image import Grid, Image, Mask
from dvc.images.noise import noise_sd
from dvc.images.resample import fill_missing
from phantoms.mri import sensitivity

_TOLERANCE_MM = 1e-7
_ROUNDS = 60
_CHUNK = 200_000
_MARGIN_MM = 12.0
_RIM_VOXELS = 2
_FEW = 1000


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticWarp:
    """A made loaded image.

    Attributes
    ----------
    image : Image
    noise_sd : float
        Of the twin, in the image's own unit.
    shown : float
        Share of the tissue whose deformed place is known and lies in the image.
    """

    image: Image
    noise_sd: float
    shown: float


def synthetic_warp(
    reference: Image,
    tissue: Mask,
    whole: Deformation,
    *,
    near: RigidMotion | None = None,
    seed: int,
    shading: bool = True,
    onto: Grid | None = None,
    noisier: float = 1.0,
    beyond_missing: bool = False,
) -> SyntheticWarp:
    """Form the image of tissue after a deformation.

    I1(x) = D(phi^-1(x)) b(x) with Rician noise, where D is the unloaded image without its noise (non-local means),
    interpolated by cubic splines, and b a smooth receive field between 0.8 and 1.2. Outside the deformed tissue all
    is air.

    Parameters
    ----------
    reference : Image
        Unloaded.
    tissue : Mask
        Body, bone included, on the unloaded image's grid; nothing else is in the twin.
    whole : Deformation
        The whole motion phi, the foot's own included: X to X + u(X), LPS mm.
    near : RigidMotion, optional
        A rigid motion close to the whole, the bone's: tissue is looked for within 30 mm of where it puts it.
    seed : int
        Of noise and receive field.
    shading : bool
        Whether the twin has a receive field of its own.
    onto : Grid, optional
        Of the twin; the unloaded image's by default.
    noisier : float
        Times the unloaded image's noise that the twin gets.
    beyond_missing : bool
        Whether the twin has no value, instead of air, where the unloaded image did not look (as ``near`` has it): a
        body goes on beyond an image's end, and a registration would follow an end that moves.

    Raises
    ------
    InputError
        If the mask does not fit the image, the deformation folds or is not defined in half of the tissue, or moves
        the tissue out of the image.

    Notes
    -----
    What it costs, against an image formed from the true anatomy: the denoising takes some fine texture for noise, so
    the twin has less of it than a scan would; what noise it leaves moves with the tissue; partial volume at borders is
    that of the unloaded scan, blurred once more by the interpolation. The first makes a registration look worse, the
    second better. On a phantom at SNR 25 and 0.8 mm, 0.42 of the noise's amplitude was left and 0.18 of the finest
    texture lost; a registration's error of the maximal shear came out 1.2 times as large in fat, 1.5 times in muscle
    and 2.5 times in bone (benchmarks/README.md).

    References
    ----------
    Buades, Coll and Morel, CVPR 2005, doi:10.1109/CVPR.2005.38 (non-local means).
    """
    if not tissue.grid.same_as(reference.grid) or not tissue.inside.any():
        raise InputError("The tissue mask is not on the unloaded image's grid, or it is empty.")
    u, H = evaluate_on_grid(whole, reference.grid, tissue.inside)
    _refuse_folds(reference.grid, tissue, u, H)
    points = tissue.points()
    moved = points + u
    known = np.flatnonzero(np.all(np.isfinite(moved), axis=1))
    grid = onto or reference.grid
    in_view = np.count_nonzero(grid.contains(moved[known])) / len(points)
    if in_view < 0.5:
        raise InputError(
            f"The deformation moves {1 - in_view:.0%} of the tissue out of the image's field of view, or is "
            "not defined there. Give one of this image, bone motion included, or a mask that fits."
        )
    sigma = noise_sd(reference, tissue)
    clean = _without_noise(reference, tissue, sigma)
    # With the rim of air around it the skin keeps its partial volume, wherever the deformation is defined there.
    drawn = Mask(tissue.grid, binary_dilation(tissue.inside, iterations=_RIM_VOXELS))
    values = _carried(clean, drawn, whole, near or RigidMotion.identity(), grid)
    if shading:
        values *= sensitivity(grid, seed + 1)
    random = np.random.default_rng(seed)
    noise = np.float32(noisier * sigma)
    values += noise * random.standard_normal(values.shape, dtype=np.float32)
    values = np.hypot(values, noise * random.standard_normal(values.shape, dtype=np.float32))
    if beyond_missing:
        came_from = (near or RigidMotion.identity()).inverse().apply(grid.points().reshape(-1, 3))
        values[~reference.grid.contains(came_from).reshape(grid.shape)] = np.nan
    return SyntheticWarp(Image(grid, values), float(noise), in_view)


def material_points(whole: Deformation, points_mm: FloatArray, start_mm: FloatArray) -> FloatArray:
    """Points X (n, 3) mm that a deformation moves to given points x (n, 3) mm; NaN where none is found.

    Newton's method on X + u(X) = x from ``start_mm`` (n, 3); where it leaves the deformation's domain or does not come
    within 1e-7 mm, there is no answer.
    """
    X = np.asarray(start_mm, dtype=np.float64)
    going = np.arange(len(X))
    found = np.full(X.shape, np.nan)
    for _ in range(_ROUNDS):
        u, H = whole.evaluate(X)
        left = points_mm[going] - X - u
        size = np.linalg.norm(left, axis=1)
        done = size < _TOLERANCE_MM
        found[going[done]] = X[done]
        kept = np.isfinite(size) & ~done & np.isfinite(H).all(axis=(1, 2))
        if not kept.any():
            break
        going, X, left, H = going[kept], X[kept], left[kept], H[kept]
        F = H + np.eye(3)
        determinant = np.linalg.det(F)
        step = np.where(
            (determinant > 1e-3)[:, None], np.linalg.solve(F + 1e-9 * np.eye(3), left[..., None])[..., 0], 0.5 * left
        )
        # a long step may leave where the map is close to linear
        X = X + step * np.minimum(1.0, 4.0 / np.maximum(np.linalg.norm(step, axis=1), 1e-12))[:, None]
    return found


def _refuse_folds(grid: Grid, tissue: Mask, u: FloatArray, H: FloatArray) -> None:
    known: BoolArray = np.all(np.isfinite(H), axis=(1, 2)) & np.all(np.isfinite(u), axis=1)
    if np.count_nonzero(known) < 0.5 * len(known):
        raise InputError(f"The deformation is defined in {known.mean():.0%} of the tissue only; half of it is needed.")
    folded = np.flatnonzero(known)[np.linalg.det(H[known] + np.eye(3)) <= 0.0]
    if len(folded):
        at = tissue.points()[folded[0]]
        raise InputError(
            f"The deformation folds (det F <= 0) in {len(folded)} voxels of the tissue, such as at LPS "
            f"({at[0]:.1f}, {at[1]:.1f}, {at[2]:.1f}) mm: no image can show it."
        )


def _without_noise(image: Image, tissue: Mask, sigma: float) -> Image:
    """The image without its noise; in the tissue's box and a little around."""
    box = tissue.box(int(np.ceil(_MARGIN_MM / image.grid.spacing_mm.min())))
    values = fill_missing(image).values[box].astype(np.float32)
    if sigma > 0:
        values = denoise_nl_means(
            values, patch_size=3, patch_distance=4, h=sigma, sigma=sigma, fast_mode=True, preserve_range=True
        )
        # Magnitudes are lifted by noise: E[m]^2 is about s^2 + sigma^2 where the signal stands clear of it.
        values = np.sqrt(np.maximum(values**2 - sigma**2, 0.0))
    return Image(image.grid.part(box), values.astype(np.float32))


def _carried(clean: Image, tissue: Mask, whole: Deformation, near: RigidMotion, grid: Grid) -> Float32Array:
    coefficients = spline_filter(clean.values.astype(np.float64), order=3, mode="mirror")
    back = _known_inverse(whole)
    # Newton's method begins at the voxel that lands nearest: one in eight of them is near enough.
    home = _thinned(tissue).points()
    there = home + whole.displacement(home)
    home = home[np.all(np.isfinite(there), axis=1)]
    moved = cKDTree(there[np.all(np.isfinite(there), axis=1)])
    out = np.zeros(int(np.prod(grid.shape)), dtype=np.float32)
    x = grid.points().reshape(-1, 3)
    where = np.flatnonzero(_near(tissue, x, near))
    for start in range(0, len(where), _CHUNK):
        some = where[start : start + _CHUNK]
        if back is not None:
            X = x[some] + back.displacement(x[some])
        else:
            X = material_points(whole, x[some], home[moved.query(x[some])[1]])
        inside = np.flatnonzero(np.isfinite(X).all(axis=1))
        inside = inside[_in_mask(tissue, X[inside])]
        at = clean.grid.indices_of(X[inside]).T
        out[some[inside]] = map_coordinates(coefficients, at, order=3, mode="mirror", prefilter=False)
    return np.maximum(out, 0.0).reshape(grid.shape)


def _thinned(tissue: Mask) -> Mask:
    """Every other voxel along each axis, or all where few are left."""
    some = np.zeros_like(tissue.inside)
    some[::2, ::2, ::2] = tissue.inside[::2, ::2, ::2]
    return Mask(tissue.grid, some) if np.count_nonzero(some) >= _FEW else tissue


def _known_inverse(whole: Deformation) -> Deformation | None:
    try:
        return whole.inverse() if isinstance(whole, Motion) else None
    except InputError:  # a composition, one of whose parts has none
        return None


def _near(tissue: Mask, points_mm: FloatArray, near: RigidMotion) -> BoolArray:
    """Points that may show tissue: within 30 mm of its box, after the rigid motion."""
    X = near.inverse().apply(points_mm)
    inside = tissue.points()
    low, high = inside.min(axis=0) - 30.0, inside.max(axis=0) + 30.0
    return np.asarray(((low <= X) & (high >= X)).all(axis=1))


def _in_mask(tissue: Mask, points_mm: FloatArray) -> BoolArray:
    """By nearest voxel."""
    at = np.rint(tissue.grid.indices_of(points_mm)).astype(np.int64)
    shape = np.array(tissue.grid.shape)
    known = np.all((at >= 0) & (at < shape), axis=1)
    held = tissue.inside[tuple(np.clip(at, 0, shape - 1).T)]
    return np.asarray(known & held)
