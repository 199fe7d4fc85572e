"""A measurement as it lies in its folder: its figures, and all of it read again, without the images."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.deformation.protocol import Deformation, Within
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import GeometryError, InputError, few
from dvc.images.image import Image, Mask
from dvc.io import error_files, result_folder as files
from dvc.measurement.error_bars import ErrorBars
from dvc.registration.register import Registration
from dvc.trust.quality import Quality
from dvc.trust.regions import RegionRow, read_regions_csv

_SHOWN = "slices_meet_at_lps_mm"
_ERROR_BARS = "error_of_max_shear"


@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """What a folder holds of a `dvc.Measurement`, by its attributes."""

    name: str
    deformation: Deformation
    maps: StrainMaps
    alignment: Mapping[str, object]
    quality: Quality
    regions: tuple[RegionRow, ...]
    error_bars: ErrorBars
    image: Image | None
    shown_mm: FloatArray | None


def read_stored(place: Path, image: Image | None) -> Stored:
    """Read the folder of one load; arguments and errors as `dvc.Measurement.read`."""
    loads = sorted({path.parent.name for path in place.glob(f"*/{files.QUALITY}")} - {files.REPEAT})
    if loads and not (place / files.QUALITY).is_file():
        raise InputError(f"{place} has several loads ({few(loads)}); read one, such as {place / loads[0]}.")
    told = files.read_quality(place)
    try:
        quality, alignment = Quality.from_dict(told), dict(told["alignment"])
        files.motion_in(alignment)
        at = np.array(told[_SHOWN].split(), dtype=np.float64) if told.get(_SHOWN) else None
    except (KeyError, TypeError, ValueError, AttributeError) as failure:
        what = f"damaged, or not written by `Measurement.write` ({failure!r})"
        raise InputError(f"{place / files.QUALITY}: {what}. {files.AGAIN}") from failure
    maps = files.read_maps(place)
    uncertainty, model = error_files.read_uncertainty(place, maps.grid) or (None, None)
    if image is not None and not image.grid.same_as(maps.grid):
        what = f"The image is on another grid ({image.grid}) than the maps in {place} ({maps.grid})"
        raise GeometryError(f"{what}. Pass the unloaded image of that measurement.")
    if image is None and (place / files.REGISTERED).is_file():
        image = files.read_scalar(place / files.REGISTERED, maps.grid)
    regions = tuple(read_regions_csv(place / files.REGIONS))
    bars = ErrorBars.from_dict(told.get(_ERROR_BARS, {}), uncertainty, model)
    if (place / files.SPLINE).is_file():  # with its own gradient, not its displacement at the voxels
        whole = files.spline_in(place)
        deformation: Deformation = Within(whole, Mask(maps.grid, maps.valid), margin_voxels=0)
    else:
        deformation = files.ResultFolder(place).deformation()
    return Stored(place.resolve().name, deformation, maps, alignment, quality, regions, bars, image, at)


def figures_to_store(
    quality: Quality, alignment: Mapping[str, object], shown_mm: FloatArray | None, found: Registration | None,
    bars: ErrorBars,
) -> dict[str, object]:  # fmt: skip
    """Content of the quality file, as plain values; ``found`` is the registration, None where there was none."""
    told = quality.as_dict() | {"alignment": dict(alignment)}
    if shown_mm is not None:
        told[_SHOWN] = " ".join(map(str, shown_mm.tolist()))
    if found is not None:
        if chosen := found.choice.as_dict():
            told["regularisation"] = chosen
        told[_ERROR_BARS] = bars.as_dict()
    return told
