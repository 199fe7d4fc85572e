"""Two images of a texture that is known everywhere, before and after a motion."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from dvc.deformation.protocol import Affine
from dvc.images.image import Grid, Image, Mask

GRID = Grid((40, 44, 36), np.array([1.0, 1.0, 1.2]), np.array([-20.0, 5.0, 3.0]))

# Were the second scan's voxels at the same places, every displacement would smooth its noise and so seem better.
_TURN = Rotation.from_rotvec([3.0, -2.0, 4.0], degrees=True).as_matrix()
TURNED = GRID.moved_by(_TURN, GRID.centre_mm - _TURN @ GRID.centre_mm)


def texture(points: np.ndarray) -> np.ndarray:
    """A smooth pattern without a period, known everywhere; wavelengths of 8 mm and more."""
    random = np.random.default_rng(8)
    waves = random.normal(size=(40, 3))
    waves *= (2.0 * np.pi / random.uniform(8.0, 20.0, 40) / np.linalg.norm(waves, axis=1))[:, None]
    return 3.0 + np.cos(points @ waves.T + random.uniform(0.0, 6.3, 40)).sum(axis=-1) / np.sqrt(40.0)


def pair_of(motion: Affine, noise: float = 0.0) -> tuple[Image, Image]:
    """Textures before and after an affine motion, I1(x) = I0(motion^-1 x), the second on a grid turned by 5 degrees."""
    return scanned(texture(GRID.points()), motion.inverse().apply(TURNED.points().reshape(-1, 3)), noise)


def scanned(first: np.ndarray, seen_at: np.ndarray, noise: float) -> tuple[Image, Image]:
    """Two images with noise: values on GRID, and the texture at places (n, 3), one for each voxel of TURNED."""
    random = np.random.default_rng(2)
    second = texture(seen_at).reshape(GRID.shape)
    first, second = (values + noise * random.standard_normal(GRID.shape) for values in (first, second))
    return Image(GRID, first.astype(np.float32)), Image(TURNED, second.astype(np.float32))


def everything() -> Mask:
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[4:-4, 4:-4, 4:-4] = True
    return Mask(GRID, inside)
