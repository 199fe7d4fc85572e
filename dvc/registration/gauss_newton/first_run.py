"""The first run on a machine: loops are compiled while another process corrects and aligns the images, then by both.

The largest loop takes almost half of the time; a loop that one process has stored is not compiled by the other.
"""

from collections.abc import Callable

import numpy as np

from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import Interfaces, InterfaceSpline
from dvc.deformation.protocol import Deformation, RigidMotion, Within, displacement_on_grid
from dvc.deformation.strain_maps import strain_maps
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.fit import control_grid
from dvc.registration.gauss_newton.image_term import ImagePair
from dvc.registration.gauss_newton.sweeps import stored

_SIZE = 16  # voxels of 1 mm along each edge
_SHIFT_MM = 0.3
_CONTROL_MM = 3.0


def compile_loops(fitting: Callable[[AlignedPair], tuple[Deformation, object]]) -> None:
    """Fit a tiny pair and take its strain, which compiles and stores every loop; nothing where they are stored."""
    if stored():
        return
    pair = _tiny_pair()
    found, _ = fitting(pair)
    _strained(pair, found)


def compile_beside(*, interfaces: bool) -> None:
    """Compile and store the loops that a fit needs beside the largest one, which another process compiles meanwhile.

    With ``interfaces``, also those of a displacement whose gradient jumps there.
    """
    if stored():
        return
    pair = _tiny_pair()
    control = control_grid(pair.fixed.grid, np.full(3, _CONTROL_MM))
    still = np.zeros((3, *control.shape))
    images = ImagePair(pair.fixed, pair.moving, pair.compared.inside, control, np.ones(3, dtype=np.int64))
    images.normal(still, np.broadcast_to(np.eye(3), (*pair.fixed.grid.shape, 3, 3)).copy())
    v = BSpline(control, still)
    _strained(pair, v)
    if interfaces and pair.labels is not None:
        _strained(pair, InterfaceSpline(v, v, Interfaces.of(pair.labels, pair.bone, _CONTROL_MM, pair.body)))


def _strained(pair: AlignedPair, found: Deformation) -> None:
    strain_maps(Within(found, pair.body), pair.body)
    displacement_on_grid(found, pair.fixed.grid, np.float32)


def _tiny_pair() -> AlignedPair:
    """Waves in a cube of skin, fat and bone, and the same moved along x."""
    grid = Grid((_SIZE,) * 3, np.ones(3), np.zeros(3))
    x, y, z = places = np.indices(grid.shape)
    depth = np.minimum(places, _SIZE - 1 - places).min(axis=0)
    labels = LabelMap(grid, np.digitize(depth, (2, 3, 6)), {1: "skin", 2: "fat", 3: "bone"})
    body, bone = Mask(grid, depth >= 2), Mask(grid, depth >= 6)
    fixed, moving = (
        Image(grid, 2.0 + np.sin(0.9 * (x - shift)) * np.cos(0.7 * y) + np.sin(0.8 * z)) for shift in (0.0, _SHIFT_MM)
    )
    return AlignedPair.of(fixed, moving, RigidMotion.identity(), body, bone, labels).cut()
