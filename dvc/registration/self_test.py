"""A registration whose result is known, for `mrstrain doctor`."""

import numpy as np
from scipy.ndimage import gaussian_filter

from dvc.arrays import FloatArray
from dvc.errors import RegistrationError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.registration.register import Settings, register

_SIZE = 32  # voxels of 1 mm along each edge
_SHIFT_MM = 0.5
_LARGEST_ERROR_MM = 0.05  # of the mean displacement
_NOISE = 0.02  # standard deviation, over that of the texture
_BONE_FROM, _RIM = 8, 0.7  # depth of the bone in voxels, and how much darker its outermost voxel is


def self_test() -> str:
    """Register a tiny pair of known shift with each form of the engine; return a sentence on what came out.

    It also compiles and stores all loops of a registration, which the first one on a machine would wait for.
    """
    fixed, moving, labels = _tiny_pair()
    bone, body = labels.region("bone"), Mask(labels.grid, labels.labels > 0)
    X, shifts = body.points(), []
    for name in ("gauss-newton", "gauss-newton-bone", "gauss-newton-borders"):
        settings = Settings.of(name, threads=1, align_on="bone" if name == "gauss-newton-bone" else "image")
        found = register(fixed, moving, bone=bone, tissue=body, labels=labels, settings=settings)
        if found.settings.engine.name != name:
            raise RegistrationError(f"{name} was replaced by {found.settings.engine.name}")
        moved = found.alignment.motion.apply(X + found.deformation.displacement(X))
        shifts.append((moved - X).mean(axis=0))
    measured = ", ".join(f"{shift[0]:.2f}" for shift in shifts)
    told = f"a shift of {_SHIFT_MM} mm was measured as {measured} mm (one spline, bone mask, label map)"
    if not np.abs(np.array(shifts) - (_SHIFT_MM, 0.0, 0.0)).max() <= _LARGEST_ERROR_MM:
        raise RegistrationError(told)
    return told


def _tiny_pair() -> tuple[Image, Image, LabelMap]:
    """A random texture, the same moved by half a voxel along x, and nested cubes of skin, fat and dark-rimmed bone."""
    random, grid = np.random.default_rng(1), Grid((_SIZE,) * 3, np.ones(3), np.zeros(3))
    fine = gaussian_filter(random.normal(size=(2 * _SIZE + 1,) * 3), 3.0)  # two points for each voxel
    at = 0.5 * (np.indices(fine.shape) - np.reshape((1.0, 0.0, 0.0), (3, 1, 1, 1)))  # in voxels of the first image
    bright = 100.0 + 20.0 * fine / fine.std()
    bright *= 1.0 - _RIM * np.exp(-((_depth(at) - _BONE_FROM - 0.5) ** 2))
    images = []
    for first in (1, 0):
        seen = bright[first : first + 2 * _SIZE : 2, : 2 * _SIZE : 2, : 2 * _SIZE : 2]
        images.append(Image(grid, seen + 20.0 * _NOISE * random.normal(size=grid.shape)))
    depth = _depth(np.indices(grid.shape, dtype=np.float64))
    labels = LabelMap(grid, np.digitize(depth, (2, 4, _BONE_FROM)), {1: "skin", 2: "fat", 3: "bone"})
    return images[0], images[1], labels


def _depth(at: FloatArray) -> FloatArray:
    """Distance of voxels (3, ...) from the nearest face of the image, in voxels."""
    return np.asarray(np.minimum(at, _SIZE - 1 - at).min(axis=0))
