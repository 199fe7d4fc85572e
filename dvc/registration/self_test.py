"""A registration whose result is known, for `mrstrain doctor`."""

import numpy as np
from scipy.ndimage import gaussian_filter

from dvc.errors import RegistrationError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.registration.register import Settings, register

_SIZE = 32  # voxels of 1 mm along each edge
_SHIFT_MM = 0.5
_LARGEST_ERROR_MM = 0.05  # of the mean displacement
_NOISE = 0.02  # standard deviation, over that of the texture


def self_test() -> str:
    """Register a tiny pair of known shift with each Gauss-Newton engine; return a sentence on what came out.

    It also compiles and stores all loops of a registration, which the first one on a machine would wait for.
    """
    fixed, moving, labels = _tiny_pair()
    bone, body = labels.region("bone"), Mask(labels.grid, labels.labels > 0)
    X, shifts = body.points(), []
    for name in ("gauss-newton", "gauss-newton-bone", "gauss-newton-borders"):
        settings = Settings.of(name, threads=1, align_on="image")
        found = register(fixed, moving, bone=bone, tissue=body, labels=labels, settings=settings)
        moved = found.alignment.motion.apply(X + found.deformation.displacement(X))
        shifts.append((moved - X).mean(axis=0))
    measured = ", ".join(f"{shift[0]:.2f}" for shift in shifts)
    told = f"a shift of {_SHIFT_MM} mm was measured as {measured} mm (one spline, bone mask, label map)"
    if not np.abs(np.array(shifts) - (_SHIFT_MM, 0.0, 0.0)).max() <= _LARGEST_ERROR_MM:
        raise RegistrationError(told)
    return told


def _tiny_pair() -> tuple[Image, Image, LabelMap]:
    """A random texture, the same moved by half a voxel along x, and nested cubes of skin, fat and bone."""
    random, grid = np.random.default_rng(1), Grid((_SIZE,) * 3, np.ones(3), np.zeros(3))
    fine = gaussian_filter(random.normal(size=(2 * _SIZE + 1,) * 3), 3.0)  # two points for each voxel
    images = []
    for first in (1, 0):
        seen = fine[first : first + 2 * _SIZE : 2, : 2 * _SIZE : 2, : 2 * _SIZE : 2] / fine.std()
        images.append(Image(grid, 100.0 + 20.0 * (seen + _NOISE * random.normal(size=grid.shape))))
    places = np.indices(grid.shape)
    depth = np.minimum(places, _SIZE - 1 - places).min(axis=0)
    return images[0], images[1], LabelMap(grid, np.digitize(depth, (2, 4, 10)), {1: "skin", 2: "fat", 3: "bone"})
