"""Removal of the bias field: every MR scan has its own receive field, which is not tissue."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from scipy import fft
from scipy.interpolate import BSpline

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.image import Image
from dvc.images.resample import fill_missing
from dvc.images.tissue import bright_voxels

_Floats = TypeVar("_Floats", FloatArray, Float32Array)

_COARSE_MM = 3.5
_SPANS = (1, 2, 4)  # of the spline along each axis, one level after the other
_ITERATIONS = 50  # at most, at each level
_CONVERGED = 1e-3
_BINS, _PADDED = 200, 512
_FULL_WIDTH = 0.15  # at half maximum, of the blur that a bias field gives the histogram, in log brightness
_WIENER_NOISE = 0.01


def without_bias_field(image: Image, bright: BoolArray | None = None) -> Image:
    """An image, above its lowest value, divided by its bias field, estimated by N4 on a coarse copy.

    Normalised correlation over the whole body takes a bias field for contrast, and a B-spline then bends tissue to
    follow it: on a phantom with fields of +-20 % that tripled the strain error. Only the registration sees the
    corrected image; outputs are made from the image as it was given. ``bright`` are its voxels that are not air, by
    default `bright_voxels`.
    """
    known, shape = fill_missing(image), image.grid.shape
    inside = bright_voxels(known) if bright is None else bright
    steps = [round(_COARSE_MM / float(spacing)) for spacing in image.grid.spacing_mm]
    steps = [int(np.clip(step, 1, max(1, n // 8))) for step, n in zip(steps, shape, strict=True)]
    coarse = tuple(slice(step // 2, None, step) for step in steps)
    if not inside[coarse].any():
        return image
    low = float(known.values.min())
    seen = known.values[coarse].astype(np.float64) - low + 1e-3 * float(np.ptp(known.values))
    axes = [np.linspace(0.0, 1.0, n) for n in shape]
    lattice = log_bias_field(np.log(seen), inside[coarse], [at[part] for at, part in zip(axes, coarse, strict=True)])
    bases = [_splines(at, _SPANS[-1]).astype(np.float32) for at in axes]
    log_field = _along(lattice.astype(np.float32), bases)
    in_tissue = log_field[inside]  # elsewhere the spline is extrapolated and may be anything
    field = np.exp(np.clip(log_field, in_tissue.min(), in_tissue.max()) - np.median(in_tissue))
    return Image(image.grid, np.float32(low) + (image.values - np.float32(low)) / field)


def log_bias_field(logarithm: FloatArray, inside: BoolArray, axes: Sequence[FloatArray]) -> FloatArray:
    """The logarithm of the bias field by N4, as coefficients of a uniform cubic B-spline on the unit cube.

    The algorithm of N. Tustison et al., 2010, doi:10.1109/TMI.2010.2046908, as ITK has it; on a regular grid its sums
    over the voxels factor into one product of matrices for each axis, which takes a twentieth of the time.

    Parameters
    ----------
    logarithm : (i, j, k)
        Logarithm of the image's values.
    inside : (i, j, k)
        Voxels to use.
    axes : three arrays, (i,), (j,) and (k,)
        Places of the voxels along each axis of the image, as shares (0 to 1) of its extent.

    Returns
    -------
    (7, 7, 7)
        Coefficients of four equal parts along each axis of the image.
    """
    lattice = np.zeros(())
    for spans in _SPANS:
        bases = [_splines(at, spans) for at in axes]
        lattice = _refined(lattice, spans) if lattice.ndim else np.zeros((spans + 3,) * 3)
        # What a voxel asks of a coefficient, w r / sum w^2, counts w^2 (Lee, Wolberg and Shin 1997).
        squares = [(basis**2).sum(axis=1) for basis in bases]
        shares = inside / (squares[0][:, None, None] * squares[1][:, None] * squares[2])
        counted = _along(inside.astype(np.float64), [basis.T**2 for basis in bases])
        counted[counted == 0.0] = np.inf
        log_field = _along(lattice, bases)[inside]
        residual = np.zeros(inside.shape)
        for _ in range(_ITERATIONS):
            corrected = logarithm[inside] - log_field
            residual[inside] = corrected - _sharpened(corrected)
            lattice = lattice + _along(residual * shares, [basis.T**3 for basis in bases]) / counted
            before, log_field = log_field, _along(lattice, bases)[inside]
            ratio = np.exp(log_field - before)
            if not ratio.std() > _CONVERGED * ratio.mean():
                break
    return lattice


def _sharpened(values: FloatArray) -> FloatArray:
    """The expected values before a Gaussian blurred their histogram, by Wiener deconvolution; like them, (n,)."""
    low, width = float(values.min()), float(np.ptp(values)) / (_BINS - 1)
    if not width > 0.0:
        return values
    bins = (values - low) / width
    first = np.minimum(bins.astype(np.intp), _BINS - 2)
    beyond = bins - first
    histogram = np.bincount(first, 1.0 - beyond, _BINS) + np.bincount(first + 1, beyond, _BINS)
    begin = (_PADDED - _BINS) // 2
    centres = low + width * (np.arange(_PADDED) - begin)
    sharpness = 4.0 * np.log(2.0) * (width / _FULL_WIDTH) ** 2
    away = np.minimum(np.arange(_PADDED), _PADDED - np.arange(_PADDED))
    blur = fft.rfft(np.sqrt(sharpness / np.pi) * np.exp(-sharpness * away**2)).real
    wiener = blur / (blur**2 + _WIENER_NOISE)
    sharp = np.maximum(fft.irfft(fft.rfft(np.pad(histogram, (begin, _PADDED - _BINS - begin))) * wiener), 0.0)
    mean, count = fft.irfft(fft.rfft(np.stack([centres * sharp, sharp])) * blur)[:, begin : begin + _BINS]
    expected = np.divide(mean, count, out=np.zeros(_BINS), where=count != 0.0)
    return np.asarray(expected[first] + beyond * (expected[first + 1] - expected[first]))


def _splines(at: FloatArray, spans: int) -> FloatArray:
    """Cubic B-splines on so many equal parts of [0, 1], at places (n,), as (n, spans + 3)."""
    knots = np.arange(-3.0, spans + 4.0) / spans
    return np.asarray(BSpline.design_matrix(at, knots, 3).toarray())


def _refined(lattice: FloatArray, spans: int) -> FloatArray:
    """The coefficients of the same spline on twice as many parts."""
    at = np.linspace(0.0, 1.0, 4 * spans + 1)
    same = np.linalg.pinv(_splines(at, spans)) @ _splines(at, spans // 2)
    return _along(lattice, [same] * 3)


def _along(values: _Floats, matrices: Sequence[_Floats]) -> _Floats:
    """Values (i, j, k) times a matrix along each axis."""
    for matrix in matrices:  # each product takes the first axis away and puts the new one last
        values = np.tensordot(values, matrix, axes=(0, 1))
    return values
