"""The error bars of a registered load: its preset's error model put on its strain map."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from dvc import figures
from dvc.arrays import BoolArray
from dvc.errors import InputError
from dvc.image import Image
from dvc.imagewrite import write_image
from dvc.noise import signal_to_noise
from dvc.planes import View
from dvc.registration import Registration
from dvc.report import Picture, Table
from dvc.strainmaps import StrainMaps
from dvc.uncertainty import POOLED, ErrorModel, Interval, Uncertainty, error_model_of, uncertainty_of
from dvc.whole import write_whole
from mrstrain.inputs import Subject
from mrstrain.page import said

_BONES = ("bone", "ankle", "calcaneus", "talus", "tibia", "fibula", "navicular", "cuboid", "cuneiform", "metatarsal")
_MOSTLY = 0.5
_SIGMA_SCALE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBars:
    """Errors of a load's maximal shear, or why they are not known.

    Attributes
    ----------
    uncertainty : Uncertainty or None
    told : str
        Where the figures come from, or the reason why there are none.
    """

    uncertainty: Uncertainty | None
    told: str

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        if self.uncertainty is None:
            return {"known": False, "reason": self.told}
        table = self.uncertainty.table
        return {"known": True, "source": self.told, "voxel_mm": table.voxel_mm, "snr": round(table.snr, 1)}

    def write(self, folder: Path, maps: StrainMaps) -> None:
        """Write ``sigma_max_shear.nii.gz`` and ``intervals.csv``, where the errors are known."""
        if self.uncertainty is None:
            return
        write_image(folder / "sigma_max_shear.nii.gz", Image(maps.grid, self.uncertainty.sigma))
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([f.name for f in fields(Interval)])
        writer.writerows(
            [f"{v:.6g}" if isinstance(v, float) else v for v in astuple(row)] for row in self.uncertainty.intervals
        )
        write_whole(folder / "intervals.csv", text.getvalue())

    def table(self) -> Table | None:
        """The intervals as the report shows them."""
        if self.uncertainty is None:
            return None
        rows = tuple(
            (i.region, _words(i.figure), i.found, i.estimate, i.low, i.high) for i in self.uncertainty.intervals
        )
        columns = ("region", "figure", "as found", "bias taken out", "95 % from", "to")
        return Table("Maximal shear with its error", columns, rows, self.told)

    def pictures(self, view: View, reference: Image) -> dict[str, Picture]:
        """The map of the standard deviation."""
        if self.uncertainty is None:
            return {}
        drawn = figures.sigma_slices(view, reference, self.uncertainty.sigma, _SIGMA_SCALE)
        return {"sigma": Picture("How sure the maximal shear is", said(figures.sigma_slices), drawn)}


def error_bars(found: Registration, subject: Subject, maps: StrainMaps, model: ErrorModel | None) -> ErrorBars:
    """Error of a registered load's maximal shear.

    Parameters
    ----------
    model : ErrorModel or None
        The user's own; where None, that of the preset.
    """
    preset = found.settings.presets[-1].name
    chosen = model or error_model_of(preset)
    if chosen is None:
        return ErrorBars(None, f"The error of {preset} has not been measured; `mrstrain accuracy` does that.")
    if chosen.preset != preset:
        return ErrorBars(None, f"The error model is that of {chosen.preset}, and {preset} was used.")
    grid = maps.grid
    voxel_mm = float(np.cbrt(grid.voxel_volume_mm3))
    try:
        table = chosen.table_for(voxel_mm, signal_to_noise(subject.reference, found.tissue))
    except InputError as far:
        return ErrorBars(None, str(far))
    bone, regions = _bone_and_tissues(subject, found.tissue.inside)
    if not bone.any():
        return ErrorBars(None, "The error depends on the distance to bone, and no bone was given.")
    to_bone = distance_transform_edt(~bone, sampling=grid.spacing_mm).astype(np.float32)
    sure = uncertainty_of(maps.max_shear, grid, regions, to_bone, table, seed=found.settings.seed)
    known = ", ".join(name for name in regions if name in table.bias and name != POOLED)
    told = (
        f"Error model of {chosen.preset} for voxels of {table.voxel_mm:.2g} mm at SNR {table.snr:.0f}: "
        f"{chosen.source}. Tissues with figures of their own: {known or 'none'}; others take those of soft tissue "
        "together. It holds for tissue that is strained and imaged like those phantoms."
    )
    return ErrorBars(sure, told)


def _bone_and_tissues(subject: Subject, tissue: BoolArray) -> tuple[BoolArray, Mapping[str, BoolArray]]:
    """Every bone that is known, and the soft tissues by name."""
    bone = np.zeros(tissue.shape, dtype=bool) if subject.bone is None else subject.bone.inside.copy()
    soft: dict[str, BoolArray] = {}
    if subject.labels is not None:
        for number, name in subject.labels.names.items():
            inside = subject.labels.labels == number
            count = np.count_nonzero(inside)
            named = any(word in name.lower() for word in _BONES)
            if named or (count and np.count_nonzero(inside & bone) > _MOSTLY * count):
                bone |= inside
            elif count:
                soft[name] = inside
    if not soft:
        soft = {POOLED: tissue & ~bone}
    return bone, {name: inside & ~bone for name, inside in soft.items()}


def _words(figure: str) -> str:
    if figure.startswith("volume_above_"):
        return f"volume above {figure.removeprefix('volume_above_').removesuffix('_ml')}, mL"
    return {"median": "median", "p90": "90th percentile", "p95": "95th percentile"}[figure]
