"""A page on which strokes of named tissues are drawn on slices of an image, and saved as a label map."""

import base64
import json
from pathlib import Path

import nibabel
import numpy as np

from dvc.atomic_files import write_whole
from dvc.images.image import Grid, Image
from dvc.report.html import packed, policy, stored, template
from dvc.report.sheet import AXES, LETTERS, PLANES, Plane, tilt_deg
from dvc.report.style import TISSUES, looks

MARKED = {1: "bone", 2: "fat", 3: "muscle", 4: "skin", 5: "tendon", 6: "other"}
"""Names of marks by number, if they have none of their own; "other" is any tissue that stands out from muscle."""
STROKES = "strokes.nii.gz"
"""The file that the page saves."""
_GREYS = 64  # steps of the image: with its noise, 256 take half as much room again
_WINDOW_PERCENT = 0.5, 99.7  # drawn black and white
_HEADER_BYTES = 352
_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def write_strokes_page(path: Path, name: str, image: Image) -> None:
    """Write a page on which strokes of tissues (`MARKED`) are drawn on an image.

    The page is one HTML file and loads nothing else. It saves the strokes as NIfTI: 8 bits, on the image's grid, voxel
    by voxel as they were drawn. Slices are cut along the image's own axes and shown as radiologists read them.
    OutputError if the file cannot be written.

    Parameters
    ----------
    path : Path
        The page.
    name : str
        File name of the image, shown on the page.
    image : Image
        Its values are kept in 64 steps of grey; missing ones are black.
    """
    known = image.values[~image.missing]
    low, high = np.percentile(known, _WINDOW_PERCENT) if known.size else (0.0, 1.0)
    scaled = (np.nan_to_num(image.values, nan=low) - low) / max(high - low, 1e-12)
    greys = np.clip(np.rint(scaled * (_GREYS - 1)), 0, _GREYS - 1).astype(np.uint8)
    about = {
        "shape": image.grid.shape, "spacing": image.grid.spacing_mm.tolist(), "greys": _GREYS, "file": STROKES,
        "views": [_view(image.grid, plane) for plane in PLANES],
    }  # fmt: skip
    style, script = stored("strokes.css"), stored("strokes.js")
    looked = looks(MARKED.values(), TISSUES)
    page = template("strokes").render(
        name=name, file=STROKES, style=style, script=script, policy=policy(style, [script]), about=json.dumps(about),
        header=base64.b64encode(_header(image.grid)).decode(), image=packed(greys.tobytes(order="F")),
        tissues=[(number, tissue, looked[tissue].colour) for number, tissue in MARKED.items()],
    )  # fmt: skip
    write_whole(path, page)


def _view(grid: Grid, plane: Plane) -> dict[str, object]:
    """How a plane lies on the page: the grid's axes across, down and through it, each with whether it runs backward."""
    order, flips = grid.axes_to_lps()
    through, across, down = AXES[plane]
    tilt = tilt_deg(grid, plane)
    axes = {
        name: {"axis": order[axis], "back": bool(flips[axis]) != turned}
        for name, axis, turned in (("through", through, False), ("across", across, False), ("down", down, down == 2))
    }
    return {"name": plane, "letters": LETTERS[plane], "tilt": round(tilt), **axes}


def _header(grid: Grid) -> bytes:
    """The header of a NIfTI file of 8 bits on the grid."""
    empty = nibabel.Nifti1Image(np.zeros(grid.shape, np.uint8), _TO_RAS @ grid.affine)
    empty.header.set_xyzt_units("mm")
    empty.set_qform(empty.affine, code=1)
    empty.set_sform(empty.affine, code=1)
    return bytes(empty.to_bytes()[:_HEADER_BYTES])
