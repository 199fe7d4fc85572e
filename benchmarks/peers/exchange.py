"""How an adapter reads its pair and writes what it found; needs SimpleITK and numpy only.

An adapter is a script, run as ``python with_tool.py FOLDER THREADS``. It reads the images of `pairs.write_pair` from
the folder and leaves there the displacement u(X) of the reference configuration, LPS mm, as ``found.mha`` (a vector
image on any grid; between its voxels it is taken as a cubic spline), or as a transform: ``found.txt`` (elastix),
``found.tfm`` (ITK) or ``found.npz`` (ours).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import SimpleITK as sitk


def arguments() -> tuple[Path, int]:
    """Folder of the pair, and threads that the tool may use."""
    return Path(sys.argv[1]), int(sys.argv[2])


def read_array(path: Path) -> np.ndarray:
    """Voxels (ni, nj, nk) in the order of the grid's axes."""
    return np.ascontiguousarray(sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T)


def write_nodes(folder: Path, displacement_voxels: np.ndarray, first: np.ndarray, step: np.ndarray) -> None:
    """Write a displacement known on a regular grid of nodes.

    Parameters
    ----------
    displacement_voxels : (ni, nj, nk, 3)
        In voxels of ``reference.mha``, along its axes.
    first, step : (3,)
        Index of the first node in ``reference.mha``, and voxels between nodes, along each axis.
    """
    reference = sitk.ReadImage(str(folder / "reference.mha"))
    spacing = np.array(reference.GetSpacing())
    direction = np.reshape(reference.GetDirection(), (3, 3))
    u = (displacement_voxels * spacing) @ direction.T
    image = sitk.GetImageFromArray(np.ascontiguousarray(u.transpose(2, 1, 0, 3)), isVector=True)
    image.SetSpacing((spacing * step).tolist())
    image.SetDirection(reference.GetDirection())
    image.SetOrigin(reference.TransformContinuousIndexToPhysicalPoint(np.asarray(first, dtype=float).tolist()))
    sitk.WriteImage(image, str(folder / "found.mha"))


def extrapolated(values: np.ndarray) -> np.ndarray:
    """Values (ni, nj, nk, 3) on a grid of nodes, with those that are NaN continued smoothly from the others.

    By thin-plate splines through the nearest known nodes, which carry a uniform strain on: no peer shall lose
    tissue near the skin, or get a false strain there, because its windows end inside the body.
    """
    from scipy.interpolate import RBFInterpolator

    known = np.isfinite(values).all(axis=-1)
    spline = RBFInterpolator(np.argwhere(known), values[known], neighbors=60, kernel="thin_plate_spline", smoothing=0.1)
    filled = values.copy()
    filled[~known] = spline(np.argwhere(~known))
    return filled
