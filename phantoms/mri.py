"""What a scanner makes of a noise-free signal: point spread, coil sensitivity, Rician noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter

from dvc.arrays import Float32Array, FloatArray
from dvc.errors import InputError
from dvc.image import Grid, Image

_BLUR_VOXELS = 0.5
_BIAS = 0.2
_CHUNK = 200_000


def acquire(
    signal: Callable[[FloatArray], FloatArray] | FloatArray,
    grid: Grid,
    *,
    snr: float | None,
    reference_signal: float,
    seed: int,
    bias_seed: int | None,
) -> Image:
    """Magnitude image of a noise-free signal.

    The signal is blurred by the point spread (Gaussian of 0.5 voxel), multiplied by a smooth coil sensitivity
    between 0.8 and 1.2, and given Rician noise: |s + n1 + i n2|, n1 and n2 normal with
    sigma = reference_signal / snr.

    Parameters
    ----------
    signal : function of points (n, 3) LPS mm returning (n,), or array (ni, nj, nk)
        A function is averaged over eight samples in each voxel; an array holds the voxels' means.
    snr : float or None
        Signal-to-noise ratio at ``reference_signal``; None for an image without noise.
    seed : int
        Of the noise.
    bias_seed : int or None
        Of the coil sensitivity; None for a uniform one.

    Raises
    ------
    InputError
        If the SNR is not positive, or an array does not fit the grid.

    References
    ----------
    Gudbjartsson and Patz, Magn Reson Med 1995, doi:10.1002/mrm.1910340618 (the Rician distribution).
    """
    if snr is not None and not snr > 0:
        raise InputError(f"The SNR must be positive, or None for an image without noise; got {snr}.")
    voxels = _voxel_means(signal, grid) if callable(signal) else np.asarray(signal)
    if voxels.shape != grid.shape:
        raise InputError(f"The signal has shape {voxels.shape}; its grid needs {grid.shape}.")
    values = gaussian_filter(voxels.astype(np.float32), _BLUR_VOXELS, mode="nearest")
    if bias_seed is not None:
        values *= sensitivity(grid, bias_seed)
    if snr is not None:
        random = np.random.default_rng(seed)
        sigma = np.float32(reference_signal / snr)
        values += sigma * random.standard_normal(grid.shape, dtype=np.float32)
        values = np.hypot(values, sigma * random.standard_normal(grid.shape, dtype=np.float32))
    return Image(grid, values)


def _voxel_means(signal: Callable[[FloatArray], FloatArray], grid: Grid) -> FloatArray:
    corners = np.array([[i, j, k] for i in (-0.25, 0.25) for j in (-0.25, 0.25) for k in (-0.25, 0.25)])
    offsets = (corners * grid.spacing_mm) @ grid.direction.T
    centres = grid.points().reshape(-1, 3)
    out = np.empty(len(centres))
    for start in range(0, len(centres), _CHUNK):
        part = slice(start, start + _CHUNK)
        out[part] = np.mean([signal(centres[part] + offset) for offset in offsets], axis=0)
    return out.reshape(grid.shape)


def sensitivity(grid: Grid, seed: int) -> Float32Array:
    """Draw a smooth multiplicative field (ni, nj, nk) of mean about 1, within 1 +- 0.2.

    A random sum of the nine cosine products of first and second order over the grid's box.
    """
    random = np.random.default_rng(seed)
    along = [(np.arange(n) + 0.5) / n for n in grid.shape]
    field = np.zeros(grid.shape)
    for orders in np.ndindex(3, 3, 3):
        if 0 < sum(orders) <= 2:
            cosines = [np.cos(np.pi * m * a) for m, a in zip(orders, along, strict=True)]
            field += random.normal() / sum(orders) * np.einsum("i,j,k->ijk", *cosines)
    field *= _BIAS / np.abs(field).max()
    return np.asarray(1.0 + field, dtype=np.float32)
