"""MR image formation from a noise-free signal: point spread, receive field (bias field), Rician noise."""

from collections.abc import Callable

import numpy as np
from scipy import fft

from dvc import Grid, Image
from dvc.arrays import Float32Array, FloatArray
from dvc.errors import InputError

_FULL = 0.6  # of the highest frequency, from which on k-space is tapered to zero
_BIAS = 0.2
_LARGEST_MM = 1.6  # octants 0.8 mm apart still resolve the smooth edges of the anatomy (to 1.1 % of the signal of fat)
_CHUNK = 200_000


def acquire(
    signal: Callable[[FloatArray], FloatArray] | FloatArray, grid: Grid, *, snr: float | None, reference_signal: float,
    seed: int, bias_seed: int | None,
) -> Image:  # fmt: skip
    """Magnitude image of a noise-free signal.

    The signal is sampled at half the spacing of `sampled_by`. Only spatial frequencies that the voxels can represent
    are kept, the highest tapered as by a scanner's filter against ringing, so the image has no aliasing. It is
    multiplied by a smooth receive field between 0.8 and 1.2, and given Rician noise (Gudbjartsson and Patz, Magn Reson
    Med 1995, doi:10.1002/mrm.1910340618): |s + n1 + i n2|, n1 and n2 normal with standard deviation ``reference_signal
    / snr``.

    Parameters
    ----------
    signal : function of points (n, 3) LPS mm returning (n,), or array (ni, nj, nk, 2, 2, 2)
        An array holds the signal in the eight octants of each voxel of ``sampled_by(grid)``, a quarter of each edge to
        either side of the centre.
    snr : float or None
        Signal-to-noise ratio at ``reference_signal``; None for an image without noise.
    seed, bias_seed : int
        Seeds of the noise and of the receive field; without the latter (None) the field is uniform.

    Raises
    ------
    InputError
        If the SNR is not positive, or an array does not fit the grid.
    """
    if snr is not None and not snr > 0:
        raise InputError(f"The SNR must be positive, or None for an image without noise; got {snr}.")
    fine = sampled_by(grid)
    octants = _octants(signal, fine) if callable(signal) else np.asarray(signal)
    if octants.shape != (*fine.shape, 2, 2, 2):
        raise InputError(f"The signal has shape {octants.shape}; its grid needs {(*fine.shape, 2, 2, 2)}.")
    values = _seen(octants.astype(np.float32), grid.shape)
    if bias_seed is not None:
        values *= sensitivity(grid, bias_seed)
    if snr is not None:
        values = rician(values, reference_signal / snr, seed)
    return Image(grid, values)


def rician(values: Float32Array, sd: float, seed: int) -> Float32Array:
    """Magnitude of a signal with complex noise of standard deviation ``sd`` in each part."""
    random, sigma = np.random.default_rng(seed), np.float32(sd)
    values = values + sigma * random.standard_normal(values.shape, dtype=np.float32)
    return np.asarray(np.hypot(values, sigma * random.standard_normal(values.shape, dtype=np.float32)))


def sampled_by(grid: Grid) -> Grid:
    """Return the grid itself; along axes whose voxels are longer than 1.6 mm, one of more voxels over the same length.

    Voxels of the two need not lie in one another: waves over the whole length are what is compared.
    """
    shape, spacing_mm = np.array(grid.shape), np.asarray(grid.spacing_mm)
    finer = np.maximum(shape, np.ceil(shape * spacing_mm / _LARGEST_MM - 1e-9)).astype(int)
    if (finer == shape).all():
        return grid
    longer = shape / finer  # the new voxel, in old ones
    i, j, k = (int(n) for n in finer)
    return Grid((i, j, k), grid.spacing_mm * longer, grid.points_at(0.5 * longer - 0.5), grid.direction)


def _octants(signal: Callable[[FloatArray], FloatArray], grid: Grid) -> FloatArray:
    corners = np.array(list(np.ndindex(2, 2, 2))) * 0.5 - 0.25
    offsets = (corners * grid.spacing_mm) @ grid.direction.T
    centres = grid.points().reshape(-1, 3)
    out = np.empty((len(centres), 8))
    for start in range(0, len(centres), _CHUNK):
        part = slice(start, start + _CHUNK)
        out[part] = np.stack([signal(centres[part] + offset) for offset in offsets], axis=-1)
    return out.reshape(*grid.shape, 2, 2, 2)


def _seen(octants: Float32Array, shape: tuple[int, int, int]) -> Float32Array:
    """Average the octants to voxels (ni, nj, nk), without frequencies that these cannot represent.

    By cosine transforms, which continue the signal as a mirror image, because the foot leaves the field of view.
    """
    ni, nj, nk = octants.shape[:3]
    values = octants.transpose(0, 3, 1, 4, 2, 5).reshape(2 * ni, 2 * nj, 2 * nk)
    for axis, n in enumerate(shape):
        kept = [slice(None)] * 3
        kept[axis] = slice(0, n)
        fade = np.clip((np.arange(n) / n - _FULL) / (1.0 - _FULL), 0.0, 1.0)
        window = (0.5 + 0.5 * np.cos(np.pi * fade)).astype(np.float32)
        spectrum = fft.dct(values, axis=axis, workers=-1)[tuple(kept)]
        spectrum *= np.float32(n / values.shape[axis]) * np.moveaxis(window[:, None, None], 0, axis)
        values = fft.idct(spectrum, axis=axis, workers=-1)
    return np.asarray(values)


def sensitivity(grid: Grid, seed: int) -> Float32Array:
    """Draw a smooth receive field (ni, nj, nk), between 0.8 and 1.2 with a mean of about 1.

    A random sum of the nine cosine products of first and second order over the grid.
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
