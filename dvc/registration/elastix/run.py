"""elastix, and nothing else of ITK: the one file that imports itk.

`register` is meant to run in a worker process (`dvc.worker`): native code may crash, and the first call in a
process takes 12 to 16 seconds.
"""

import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from dvc.errors import RegistrationError
from dvc.images.image import Grid, Image, Mask
from dvc.images.itk_image import to_itk

_LOG = "elastix.log"


def register(
    fixed: Image, moving: Image, parameters: Mapping[str, tuple[str, ...]], fixed_mask: Mask | None,
    moving_mask: Mask | None, initial_transform: str | None, folder: str,
) -> dict[str, tuple[str, ...]]:  # fmt: skip
    """The parameter map, every value as text, of the transform from points of `fixed` (LPS mm) to those of `moving`.

    The images have no missing values; samples are taken inside the fixed mask only. The parameters are complete
    (`Preset.complete`), and say how a transform file to start from is combined. elastix leaves its log and iteration
    tables, which tell the progress, in the folder; RegistrationError with the reason that it wrote to its log.
    """
    import itk

    image_type = itk.Image[itk.F, 3]
    parameter_object = itk.ParameterObject.New()
    parameter_object.AddParameterMap({name: list(values) for name, values in parameters.items()})
    method = itk.ElastixRegistrationMethod[image_type, image_type].New()
    method.SetFixedImage(to_itk(fixed.grid, fixed.values, itk))
    method.SetMovingImage(to_itk(moving.grid, moving.values, itk))
    for mask, set_mask in ((fixed_mask, method.SetFixedMask), (moving_mask, method.SetMovingMask)):
        if mask is not None:
            set_mask(to_itk(mask.grid, mask.inside.astype(np.uint8), itk))
    if initial_transform is not None:
        method.SetInitialTransformParameterFileName(initial_transform)
    method.SetParameterObject(parameter_object)
    method.SetOutputDirectory(folder)
    method.SetLogFileName(_LOG)
    method.SetLogToFile(True)
    method.SetLogToConsole(False)
    try:
        method.UpdateLargestPossibleRegion()
    except RuntimeError as failure:
        raise RegistrationError(f"elastix failed: {_reason_in(Path(folder) / _LOG)}") from failure
    found = method.GetTransformParameterObject().GetParameterMap(0)
    return {str(name): tuple(str(v) for v in found[name]) for name in found}


def self_test() -> str:
    """Register a small pair of known shift; return a sentence on what came out, for `mrstrain doctor`."""
    from scipy.ndimage import zoom

    from dvc.registration.elastix.presets import load_preset

    values = zoom(np.random.default_rng(0).normal(size=(10, 10, 10)).astype(np.float32), 4.0, order=3)
    grid, shifted = (Grid((40, 40, 40), np.ones(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.5))
    short = {"Transform": ("TranslationTransform",), "MaximumNumberOfIterations": ("80",)}
    parameters = load_preset("heel-mr").complete(seed=1) | short
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        found = register(Image(grid, values), Image(shifted, values), parameters, None, None, None, folder)
    shift = float(found["TransformParameters"][0])
    if abs(shift - 1.5) > 0.05:
        raise RegistrationError(f"elastix measured a shift of {shift:.3f} mm; the true shift is 1.5 mm.")
    return f"a shift of 1.5 mm was measured as {shift:.3f} mm"


def finished_iterations(folder: Path) -> int:
    """Number of iterations that elastix has written so far into ``folder``, over all resolutions."""
    count = 0
    for table in folder.glob("IterationInfo.*.txt"):
        with suppress(OSError):
            count += max(0, table.read_bytes().count(b"\n") - 1)
    return count


def _reason_in(log: Path) -> str:
    """The reason of a failure, as elastix wrote it to its log."""
    try:
        text = log.read_text(errors="replace")
    except OSError:
        return "it wrote no log; the images may have values that it cannot use"
    described = re.findall(r"Description:\s*(?:ITK ERROR:)?\s*(.+)", text)
    told = [line.strip() for line in text.splitlines() if re.search(r"\berror\b|exception", line, re.IGNORECASE)]
    reasons = [re.sub(r"\(0x[0-9a-f]+\)", "", r).strip() for r in (described or told)]
    unique = list(dict.fromkeys(r for r in reasons if r and not r.startswith("---")))
    return "; ".join(unique[:3]) if unique else f"its log gives no reason; the log ends with: {text.strip()[-200:]}"
