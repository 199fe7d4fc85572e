"""Removal of the bias field: every MR scan has its own receive field, which is not tissue."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from itertools import repeat

import numpy as np
import SimpleITK as sitk

from dvc.images.image import Grid, Image
from dvc.images.itk_image import from_sitk, to_sitk
from dvc.images.resample import fill_missing
from dvc.images.tissue import bright_voxels

_COARSE_MM = 3.5
_CONTROL_POINTS = 4
_ITERATIONS = [50, 50, 50]


def without_bias_field(images: Sequence[Image], threads: int = 1) -> list[Image]:
    """Images, above their lowest value, divided by their bias fields, estimated by N4 on coarse copies.

    As many at once as there are threads; the result is the same bit for bit on any number of them. The first image, the
    unloaded one of a series, is kept in corrected form, so that the next load need not correct it again.

    Normalised correlation over the whole body takes a bias field for contrast, and a B-spline then bends tissue to
    follow it: on a phantom with fields of +-20 % that tripled the strain error. Only the registration sees the
    corrected image; outputs are made from the image as it was given. N4: N. Tustison et al., 2010,
    doi:10.1109/TMI.2010.2046908.
    """
    usual = sitk.ProcessObject.GetGlobalDefaultNumberOfThreads()
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)  # N4's sums, and so its bits, depend on their number
    try:
        with ThreadPoolExecutor(threads) as pool:
            corrected = (_first_corrected, *repeat(_corrected, len(images) - 1))
            return list(pool.map(lambda correct, image: correct(image), corrected, images))
    finally:
        sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(usual)


_kept: dict[bytes, Image] = {}  # the last first image in corrected form, by the hash of its contents


def _first_corrected(image: Image) -> Image:
    contents = sha256(np.ascontiguousarray(image.values).data)
    contents.update(image.grid.affine.tobytes())
    corrected = _kept.get(contents.digest())
    if corrected is None:
        corrected = _corrected(image)
        _kept.clear()
        _kept[contents.digest()] = corrected
    return corrected


def _corrected(image: Image) -> Image:
    known = fill_missing(image)
    inside = bright_voxels(known)
    if not inside.any():
        return image
    low = float(known.values.min())
    box = Grid(image.grid.shape, image.grid.spacing_mm, np.zeros(3))  # N4 works along the image's own axes
    scan = to_sitk(box, known.values - low + 1e-3 * float(np.ptp(known.values)))
    mask = to_sitk(box, inside.astype(np.uint8))
    edges = zip(image.grid.spacing_mm, image.grid.shape, strict=True)
    shrink = [int(np.clip(round(_COARSE_MM / s), 1, max(1, n // 8))) for s, n in edges]
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations(_ITERATIONS)
    n4.SetNumberOfControlPoints([_CONTROL_POINTS] * 3)
    n4.Execute(sitk.Shrink(scan, shrink), sitk.Shrink(mask, shrink))
    _, log_field = from_sitk(n4.GetLogBiasFieldAsImage(scan))
    in_tissue = log_field[inside]  # elsewhere the spline is extrapolated and may be anything
    field = np.exp(np.clip(log_field, in_tissue.min(), in_tissue.max()) - float(np.median(in_tissue)))
    return Image(image.grid, low + (image.values - low) / field.astype(np.float32))
