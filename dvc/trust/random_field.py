"""Gaussian random fields of a given smoothness: how errors of neighbouring voxels go together."""

import numpy as np
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from dvc.arrays import FloatArray, IntArray


class GaussianField:
    """Gaussian fields of unit variance at some voxels ``at`` of a lattice, smooth over ``width`` voxels."""

    def __init__(
        self, shape: tuple[int, ...], at: tuple[IntArray, ...], width: FloatArray, random: np.random.Generator
    ) -> None:
        self._width, self._random = width, random
        # Room around, so that the field, which is periodic, does not meet itself.
        room = np.ceil(6.0 * width).astype(int)
        self._shape = tuple(int(n + r) for n, r in zip(shape, room, strict=True))
        self._at = at
        spread = np.ones(())
        for w in width:
            kernel = gaussian_filter1d(np.eye(1, 2 * int(4 * w + 1) + 1, int(4 * w + 1))[0], w, mode="constant")
            spread = spread * (kernel**2).sum()
        self._scale = 1.0 / np.sqrt(float(spread))

    def drawn(self) -> FloatArray:
        """Draw the values at the region's voxels, (n,)."""
        smooth = gaussian_filter(self._random.standard_normal(self._shape), self._width, mode="wrap")
        return np.asarray(self._scale * smooth[self._at])
