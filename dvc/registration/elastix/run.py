"""elastix, and nothing else of ITK: the one file that imports itk.

`register` is meant to run in a worker process (`dvc.worker`): native code may crash, and the first call in a
process takes 12 to 16 seconds.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.errors import RegistrationError
from dvc.images.image import Grid, Image, Mask
from dvc.images.itk_image import to_itk

Parameters = Mapping[str, tuple[str, ...]]

LOG_NAME = "elastix.log"
_ITERATIONS = "IterationInfo.*.txt"
_SELF_TEST: dict[str, tuple[str, ...]] = {
    "Registration": ("MultiResolutionRegistration",),
    "Metric": ("AdvancedNormalizedCorrelation",),
    "Optimizer": ("AdaptiveStochasticGradientDescent",),
    "Transform": ("TranslationTransform",),
    "Interpolator": ("LinearInterpolator",),
    "ImageSampler": ("RandomCoordinate",),
    "FixedImagePyramid": ("FixedSmoothingImagePyramid",),
    "MovingImagePyramid": ("MovingSmoothingImagePyramid",),
    "AutomaticTransformInitialization": ("false",),
    "AutomaticParameterEstimation": ("true",),
    "NewSamplesEveryIteration": ("true",),
    "NumberOfResolutions": ("2",),
    "MaximumNumberOfIterations": ("300",),
}


@dataclass(frozen=True, slots=True)
class Registered:
    """What elastix found.

    Attributes
    ----------
    transform : mapping
        The transform's parameter map, every value as text.
    final_metric : float
        Mean of the metric over the last tenth of the last resolution's iterations; its sign and size are
        elastix' (normalised correlation: -1 is perfect).
    """

    transform: dict[str, tuple[str, ...]]
    final_metric: float


def register(
    fixed: Image,
    moving: Image,
    parameters: Parameters,
    fixed_mask: Mask | None,
    moving_mask: Mask | None,
    initial_transform: str | None,
    folder: str,
) -> Registered:
    """Run one elastix registration.

    Parameters
    ----------
    fixed, moving : Image
        The transform found maps points of ``fixed`` (LPS mm) to points of ``moving``. No missing values.
    parameters : mapping
        elastix parameters, complete (see `dvc.registration.elastix.presets`).
    fixed_mask, moving_mask : Mask, optional
        On the grids of their images; samples are taken inside the fixed mask only.
    initial_transform : str, optional
        Path of an elastix transform file to start from; combined as the parameters say.
    folder : str
        Existing folder for elastix' log and iteration tables, which tell the progress.

    Raises
    ------
    RegistrationError
        With the reason that elastix wrote to its log.
    """
    import itk

    image_type = itk.Image[itk.F, 3]
    parameter_object = itk.ParameterObject.New()
    parameter_object.AddParameterMap({name: list(values) for name, values in parameters.items()})
    method = itk.ElastixRegistrationMethod[image_type, image_type].New()
    method.SetFixedImage(to_itk(fixed.grid, fixed.values, itk))
    method.SetMovingImage(to_itk(moving.grid, moving.values, itk))
    if fixed_mask is not None:
        method.SetFixedMask(to_itk(fixed_mask.grid, fixed_mask.inside.astype(np.uint8), itk))
    if moving_mask is not None:
        method.SetMovingMask(to_itk(moving_mask.grid, moving_mask.inside.astype(np.uint8), itk))
    if initial_transform is not None:
        method.SetInitialTransformParameterFileName(initial_transform)
    method.SetParameterObject(parameter_object)
    method.SetOutputDirectory(folder)
    method.SetLogFileName(LOG_NAME)
    method.SetLogToFile(True)
    method.SetLogToConsole(False)
    try:
        method.UpdateLargestPossibleRegion()
    except RuntimeError as failure:
        raise RegistrationError(f"elastix failed: {reason_in_log(Path(folder) / LOG_NAME)}") from failure
    found = method.GetTransformParameterObject().GetParameterMap(0)
    transform = {str(name): tuple(str(v) for v in found[name]) for name in found}
    return Registered(transform, _final_metric(Path(folder)))


def self_test() -> str:
    """Register a small pair of known shift; return a sentence on what came out, for `mrstrain doctor`."""
    from dvc.registration.elastix.presets import Preset

    rng = np.random.default_rng(0)
    coarse = rng.normal(size=(10, 10, 10)).astype(np.float32)
    grid = Grid((40, 40, 40), np.ones(3), np.zeros(3))
    from scipy.ndimage import zoom

    values = zoom(coarse, 4.0, order=3)
    shifted = Grid((40, 40, 40), np.ones(3), np.array([1.5, 0.0, 0.0]))
    parameters = Preset("self-test", "", _SELF_TEST).complete(seed=1)
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        found = register(Image(grid, values), Image(shifted, values), parameters, None, None, None, folder)
    shift = float(found.transform["TransformParameters"][0])
    if abs(shift - 1.5) > 0.05:
        raise RegistrationError(f"elastix found a shift of {shift:.3f} mm where 1.5 mm is true.")
    return f"a shift of 1.5 mm was found as {shift:.3f} mm"


def finished_iterations(folder: Path) -> int:
    """Number of iterations that elastix has written so far into ``folder``, over all resolutions."""
    count = 0
    for table in folder.glob(_ITERATIONS):
        try:
            count += max(0, table.read_bytes().count(b"\n") - 1)
        except OSError:
            continue
    return count


def _final_metric(folder: Path) -> float:
    tables = sorted(folder.glob(_ITERATIONS))
    if not tables:
        return float("nan")
    rows = tables[-1].read_text().splitlines()[1:]
    metric = [float(row.split("\t")[1]) for row in rows if row.strip()]
    return float(np.mean(metric[-max(1, len(metric) // 10) :])) if metric else float("nan")


def reason_in_log(log: Path) -> str:
    """The reason of a failure, as elastix wrote it to its log."""
    try:
        text = log.read_text(errors="replace")
    except OSError:
        return "it left no log; the images may hold values it cannot use"
    described = re.findall(r"Description:\s*(?:ITK ERROR:)?\s*(.+)", text)
    told = [line.strip() for line in text.splitlines() if re.search(r"\berror\b|exception", line, re.IGNORECASE)]
    reasons = [re.sub(r"\(0x[0-9a-f]+\)", "", r).strip() for r in (described or told)]
    unique = list(dict.fromkeys(r for r in reasons if r and not r.startswith("---")))
    return "; ".join(unique[:3]) if unique else f"its log gives no reason; its last line is: {text.strip()[-200:]}"
