"""Volumes to turn and cut on a report page, drawn by niivue (WebGL 2) from data that the page itself holds."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import nibabel
import numpy as np
import numpy.typing as npt

from dvc.images.image import Grid

_STEPS = 250  # of a volume's values: one byte for each voxel
_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])

NIIVUE = "0.69.0"
"""Version of the viewer that comes with the package."""


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """A volume as a page holds it: NIfTI, eight bits, compressed, base64; ``most`` is the value of the last colour."""

    title: str
    data: str
    most: float

    @classmethod
    def of(cls, title: str, grid: Grid, values: npt.NDArray[np.floating], most: float) -> Volume:
        """Values (ni, nj, nk) on a grid, from 0 to ``most``; NaN becomes 0, which an overlay does not show."""
        known = np.nan_to_num(np.asarray(values, dtype=np.float64), nan=0.0)
        step = most / _STEPS
        image = nibabel.Nifti1Image(np.clip(np.rint(known / step), 0, 255).astype(np.uint8), _TO_RAS @ grid.affine)
        image.header.set_slope_inter(step, 0.0)
        return cls(title, base64.b64encode(gzip.compress(image.to_bytes(), mtime=0)).decode(), most)


@dataclass(frozen=True, slots=True, eq=False)
class Viewer:
    """An image, and scalars in colour over it, each on a canvas of its own; they turn and scroll together."""

    title: str
    caption: str
    image: Volume
    overlays: tuple[Volume, ...]


@cache
def script() -> str:
    """The library and what starts it, for a page that has a viewer; with the library's licence."""
    folder = files("dvc.report") / "templates"
    licence = (folder / "niivue-LICENSE.txt").read_text(encoding="utf-8")
    library = (folder / "niivue.umd.js").read_text(encoding="utf-8")
    return f"/* niivue {NIIVUE}\n{licence}*/\n{library}\n{(folder / 'viewer.js').read_text(encoding='utf-8')}"
