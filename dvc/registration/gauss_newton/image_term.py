"""How well a displacement brings two images together, voxel by voxel, and the normal equations of improving it.

The residual is ``r(X) = a(X) I0(X) - I1(X + u(X))``, with a smooth gain a (the images' bias fields differ), over
all voxels of a mask. Its derivative by u is taken from the *fixed* image, carried by the deformation:
``grad I1 = a F^-T grad I0``. At voxels, the noise of an image is not correlated with its own central difference; the
moving image's gradient at places between voxels is correlated with its noise there, and pulls the result after it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray, frozen
from dvc.compiled import njit
from dvc.deformation.bspline import Table
from dvc.deformation.interface_spline import Interfaces
from dvc.images.filters import gaussian, spline_coefficients
from dvc.images.image import Grid, Image
from dvc.images.interpolation import cubic_at
from dvc.images.resample import fill_missing
from dvc.registration.gauss_newton.spline_sums import SplineSums
from dvc.registration.gauss_newton.sweeps import plane_sums
from dvc.threads import in_parts

_GAIN_MM = 10.0
_FINE = 3.0  # blocks: a window of a larger standard deviation is laid on coarser ones
_CUBE = 4  # voxels; finer halves share the noise of neighbours through gradients and interpolation

_Scene = tuple[Float32Array, BoolArray, FloatArray, FloatArray]
"""The moving image's spline coefficients, its gaps, and its index at s mm along the fixed one's axes, per_mm s + start.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Normal equations of the images at a displacement, for the voxels that were asked for.

    With g the derivative of the moving image, and B the splines of the coefficients.
    """

    matrix: FloatArray  # (bi, bj, bk, 6), sums over each block of g g^T: xx, xy, xz, yy, yz, zz
    force: FloatArray  # (3, mi, mj, mk), sums over the voxels of r g B
    square: float  # sum of r^2
    count: int  # voxels that both images show
    left_out: float  # mean of r^2 over such voxels of the other half; NaN if all were asked for
    shown: BoolArray  # (bi, bj, bk), blocks with such a voxel of either half


class ImagePair:
    """Two images, sampled, and the voxels `inside` the fixed one and the blocks over which they are compared.

    Components of the displacement, and control points, are along the axes of `fixed`. Normal matrices, gain and strain
    are held by blocks of so many voxels along each axis. Nearer than `rim_mm` to its ends and gaps the moving image is
    not used: blurred there, it shows what lies beyond. With `interfaces`, strain is taken at the first voxel
    of each block, which lies in one tissue; without, at the block's centre.
    """

    def __init__(
        self, fixed: Image, moving: Image, inside: BoolArray, control: Grid, block: IntArray, rim_mm: float = 0.0,
        interfaces: Interfaces | None = None,
    ) -> None:  # fmt: skip
        self.grid, self.block = fixed.grid, block
        missing = fixed.missing
        # Read-only and in C order, as images are: of each kind of array a kernel is compiled anew.
        self.inside = frozen(inside & ~binary_dilation(missing) if missing.any() else inside, np.bool_)
        self._fixed = np.ascontiguousarray(fill_missing(fixed).values)
        filled = fill_missing(moving).values
        splines = spline_coefficients(filled, np.float32)
        start = moving.grid.indices_of(self.grid.origin_mm)
        ends = moving.grid.indices_of(self.grid.origin_mm + self.grid.direction.T)
        self._scene: _Scene = (splines, _gaps(moving, rim_mm), np.ascontiguousarray((ends - start).T), start)
        self._step = np.array(self.grid.spacing_mm)
        axes = list(zip(control.indices_of(self.grid.origin_mm), self._step / control.spacing_mm, block, strict=True))
        along = [a + s * np.arange(n) for (a, s, _), n in zip(axes, self.grid.shape, strict=True)]
        self.sums = SplineSums(control, along, self.inside)
        # (ni, nj, nk, splines): what the splines are multiplied by at the voxels
        self._factors = np.ones((0, 0, 0, 0))
        self._first: tuple[slice, ...] | None = None
        compared = self.share(inside) > 0  # a block is, if any voxel of it is: before `_first` is set
        if interfaces is None:
            counts = zip(axes, compared.shape, strict=True)
            middles = [a + s * ((np.arange(n) + 0.5) * b - 0.5) for (a, s, b), n in counts]
            self.blocks = SplineSums(control, middles, compared)
        else:
            self._first = tuple(slice(None, None, int(b)) for b in block)
            firsts = [a[f] for a, f in zip(along, self._first, strict=True)]
            shift = interfaces.reach_mm if interfaces.of_bone_alone else 0.0
            self.blocks = SplineSums(control, firsts, compared, interfaces.at_voxels(compared, block), shift)
            self._factors = interfaces.at_voxels(self.inside, gradient=False)[..., 0]
        self._carried = np.zeros(self.grid.shape, dtype=np.float32)

    def share(self, where: BoolArray) -> FloatArray:
        """Volume of each block that lies in ``where``, mm3; with interfaces, all of it where its first voxel does."""
        if self._first is not None:
            return np.asarray(where[self._first] * float(np.prod(self.block)) * self.grid.voxel_volume_mm3)
        padded = np.pad(where, [(0, -n % b) for n, b in zip(where.shape, self.block, strict=True)])
        (a, b, c), (i, j, k) = self.block, padded.shape // self.block
        counted = padded.reshape(i, a, j, b, k, c).sum(axis=(1, 3, 5))
        return np.asarray(counted * self.grid.voxel_volume_mm3)

    def normal(self, coefficients: FloatArray, pulled: FloatArray, halves: int = -1) -> Normal:
        """Normal equations at a displacement with coefficients (3 splines, mi, mj, mk).

        `pulled` (bi, bj, bk, 3, 3) is F^-T at the blocks, which turns gradients of the fixed image into those of the
        moving one. Of the voxels one half (0 or 1) is taken, every other cube of 4 x 4 x 4 as on a chessboard, or
        all (-1).
        """
        shape = self.blocks.inside.shape
        both, own = np.zeros(shape), np.zeros(shape)
        in_parts(
            _carry, len(both), coefficients, self.inside, self.sums.table, self._factors, self._fixed,
            self._scene, self._step, self.block, self._carried, both, own,
        )  # fmt: skip
        gain = _gain(both, own, _GAIN_MM / (self.block * self.grid.spacing_mm))
        matrix, sums = np.zeros((*shape, 6)), np.zeros((shape[0], 4))
        half = np.zeros((self.grid.shape[0], coefficients.shape[0], 2, *self.sums.control.shape[1:]))
        in_parts(
            _normal, len(gain), self._fixed, self._carried, self.inside, halves, gain, pulled, self._step, self.block,
            self.sums.table, self._factors, matrix, sums, half,
        )  # fmt: skip
        square, count, other, others = sums.sum(axis=0)
        left_out = float(other / others) if others else np.nan
        return Normal(matrix, self.sums.closed(half), float(square), int(count), left_out, own > 0.0)


def _gain(both: FloatArray, own: FloatArray, sigma: FloatArray) -> FloatArray:
    """The gain at blocks: sums of I0 I1 over sums of I0 I0, each in a Gaussian window of so many blocks.

    Where that is wide, windows are laid on coarser blocks, and the gain is linear between their centres.
    """
    times = np.maximum((sigma / _FINE).astype(int), 1)
    shape = own.shape

    def windowed(sums: FloatArray) -> FloatArray:
        padded = np.pad(sums, [(0, -n % t) for n, t in zip(shape, times, strict=True)])
        i, j, k = padded.shape // times
        coarse = padded.reshape(i, times[0], j, times[1], k, times[2]).sum(axis=(1, 3, 5))
        return np.asarray(gaussian(coarse, sigma / times, "constant"))

    smooth = windowed(own)
    gain = windowed(both) / np.maximum(smooth, 1e-9 * smooth.max() + 1e-30)
    for axis, (count, t) in enumerate(zip(shape, times, strict=True)):
        if t == 1:
            continue
        last = gain.shape[axis] - 1
        at = np.clip((np.arange(count) + 0.5) / t - 0.5, 0.0, last)
        low = np.minimum(at.astype(int), max(last - 1, 0))
        share = (at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        gain = (1.0 - share) * gain.take(low, axis) + share * gain.take(np.minimum(low + 1, last), axis)
    return np.ascontiguousarray(gain)


def _gaps(image: Image, rim_mm: float) -> BoolArray:
    """Voxels that cannot be used: missing ones, their neighbours, and a rim around them and along the image's ends."""
    rim, missing = np.rint(rim_mm / image.grid.spacing_mm).astype(int), image.missing
    gaps = np.ones(image.grid.shape, dtype=bool)
    gaps[tuple(slice(n, size - n) for n, size in zip(rim, gaps.shape, strict=True))] = False
    return gaps | binary_dilation(missing, iterations=max(2, int(rim.max()))) if missing.any() else gaps


@njit(cache=True)
def _interpolated(image: Float32Array, gaps: BoolArray, x: float, y: float, z: float) -> float:
    """Cubic spline at a continuous index; NaN beyond the voxels' centres and near gaps."""
    ni, nj, nk = image.shape
    if not (0.0 <= x <= ni - 1 and 0.0 <= y <= nj - 1 and 0.0 <= z <= nk - 1):
        return np.nan
    if gaps[int(x + 0.5), int(y + 0.5), int(z + 0.5)]:
        return np.nan
    return float(cubic_at(image, x, y, z))


@njit(nogil=True, cache=True)
def _carry(
    begin: int, end: int, c: FloatArray, inside: BoolArray, table: Table, factors: FloatArray, fixed: Float32Array,
    scene: _Scene, step: FloatArray, block: IntArray, carried: Float32Array, both: FloatArray, own: FloatArray,
) -> None:  # fmt: skip
    """I1(X + u) at the voxels, and sums of I0 I1 and I0 I0 over each block."""
    first, second, last = table
    moving, gaps, per_mm, start = scene
    ni, nj, nk = inside.shape
    alone = factors.shape[3] == 0
    splines = 1 if alone else factors.shape[3]
    for bi in range(begin, end):
        plane, row = np.empty((c.shape[0], 2, c.shape[2], c.shape[3])), np.empty((c.shape[0], c.shape[3]))
        for i in range(bi * block[0], min(ni, (bi + 1) * block[0])):
            if not inside[i].any():
                continue
            plane_sums(c, first[0][i], first[1][i], first[2][i], plane)
            for j in range(nj):
                if not inside[i, j].any():
                    continue
                at = second[0][j]
                for m in range(row.shape[0]):
                    for k in range(row.shape[1]):
                        total = 0.0
                        for q in range(4):
                            total += second[1][j, q] * plane[m, 0, at + q, k]
                        row[m, k] = total
                for k in range(nk):
                    if not inside[i, j, k]:
                        continue
                    s = (i * step[0], j * step[1], k * step[2])
                    x, y, z = start[0], start[1], start[2]
                    for m in range(3):
                        place = s[m]
                        for f in range(splines):
                            a = 1.0 if alone else factors[i, j, k, f]
                            for r in range(4):
                                place += a * last[1][k, r] * row[3 * f + m, last[0][k] + r]
                        x += per_mm[0, m] * place
                        y += per_mm[1, m] * place
                        z += per_mm[2, m] * place
                    found = _interpolated(moving, gaps, x, y, z)
                    carried[i, j, k] = found
                    if not np.isnan(found):
                        here = fixed[i, j, k]
                        both[bi, j // block[1], k // block[2]] += here * found
                        own[bi, j // block[1], k // block[2]] += here * here


@njit(nogil=True, cache=True)
def _normal(
    begin: int, end: int, fixed: Float32Array, carried: Float32Array, inside: BoolArray, halves: int, gain: FloatArray,
    pulled: FloatArray, step: FloatArray, block: IntArray, table: Table, factors: FloatArray, matrix: FloatArray,
    sums: FloatArray, half: FloatArray,
) -> None:  # fmt: skip
    """Sums of g g^T over blocks, of r g B by plane, and (bi, 4) of r^2 and voxels, in this half and in the other."""
    _, second, last = table
    ni, nj, nk = inside.shape
    alone = factors.shape[3] == 0
    splines = 1 if alone else factors.shape[3]
    for bi in range(begin, end):
        row = np.empty((half.shape[1], half.shape[4]))
        for i in range(bi * block[0], min(ni, (bi + 1) * block[0])):
            before_i, after_i = max(i - 1, 0), min(i + 1, ni - 1)
            for j in range(nj):
                if not inside[i, j].any():
                    continue
                bj, before_j, after_j = j // block[1], max(j - 1, 0), min(j + 1, nj - 1)
                row[:] = 0.0
                for k in range(nk):
                    found = carried[i, j, k]
                    if not inside[i, j, k] or np.isnan(found):
                        continue
                    bk = k // block[2]
                    a, T = gain[bi, bj, bk], pulled[bi, bj, bk]
                    r = a * fixed[i, j, k] - found
                    if halves >= 0 and (i // _CUBE + j // _CUBE + k // _CUBE) % 2 != halves:
                        sums[bi, 2] += r * r
                        sums[bi, 3] += 1.0
                        continue
                    x = a * (fixed[after_i, j, k] - fixed[before_i, j, k]) / (2.0 * step[0])
                    y = a * (fixed[i, after_j, k] - fixed[i, before_j, k]) / (2.0 * step[1])
                    z = a * (fixed[i, j, min(k + 1, nk - 1)] - fixed[i, j, max(k - 1, 0)]) / (2.0 * step[2])
                    g = (
                        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
                        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
                        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
                    )
                    N = matrix[bi, bj, bk]
                    N[0] += g[0] * g[0]
                    N[1] += g[0] * g[1]
                    N[2] += g[0] * g[2]
                    N[3] += g[1] * g[1]
                    N[4] += g[1] * g[2]
                    N[5] += g[2] * g[2]
                    sums[bi, 0] += r * r
                    sums[bi, 1] += 1.0
                    for f in range(splines):
                        share = r if alone else r * factors[i, j, k, f]
                        for m in range(3):
                            for q in range(4):
                                row[3 * f + m, last[0][k] + q] += last[1][k, q] * share * g[m]
                for m in range(row.shape[0]):
                    for q in range(4):
                        for k in range(row.shape[1]):
                            half[i, m, 0, second[0][j] + q, k] += second[1][j, q] * row[m, k]
