"""The error bars of a registered load: its preset's error model put on its strain map."""

from __future__ import annotations

import csv
import hashlib
import io
import re
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

import numpy as np

from dvc import figures
from dvc.arrays import BoolArray, FloatArray
from dvc.errors import InputError
from dvc.image import Image
from dvc.imagewrite import write_image
from dvc.noise import signal_to_noise
from dvc.planes import View
from dvc.registration import Registration, Settings
from dvc.report import Picture, Table
from dvc.strainmaps import StrainMaps
from dvc.tissue import tissue_mask
from dvc.uncertainty import (
    POOLED,
    ErrorModel,
    ErrorTable,
    Interval,
    Uncertainty,
    to_surface_mm,
    uncertainty_of,
)
from dvc.verdict import Verdict
from dvc.whole import write_whole
from mrstrain.inputs import Subject
from mrstrain.page import said

_BONES = {"bone", "bones", "ankle", "calcaneus", "talus", "tibia", "fibula", "navicular", "cuboid", "cuneiform"}
_SOFT = {"fat", "pad", "muscle", "skin", "tendon", "ligament", "fascia", "aponeurosis", "tissue", "cartilage"}
_MOSTLY = 0.5
_UNLABELLED = 0.1
_SIGMA_SCALE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBars:
    """Errors of a load's maximal shear, or why they are not known.

    Attributes
    ----------
    uncertainty : Uncertainty or None
    told : str
        Where the figures come from, or the reason why there are none.
    model : ErrorModel or None
        With the one table that was used.
    """

    uncertainty: Uncertainty | None
    told: str
    model: ErrorModel | None = None

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        if self.uncertainty is None:
            return {"known": False, "reason": self.told}
        table = self.uncertainty.table
        voxel = table.spacing_mm.tolist()
        return {"known": True, "source": self.told, "voxel_mm": voxel, "snr": round(table.snr, 1)}

    def write(self, folder: Path, maps: StrainMaps, verdict: Verdict) -> None:
        """Write ``sigma_max_shear.nii.gz``, ``intervals.csv`` and the ``error_model.json`` used, if there are any.

        The registration's verdict stands beside every interval: of one that failed they tell nothing.
        """
        if self.uncertainty is None:
            return
        if self.model is not None:
            self.model.write(folder / "error_model.json")
        write_image(folder / "sigma_max_shear.nii.gz", Image(maps.grid, self.uncertainty.sigma))
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*(f.name for f in fields(Interval)), "verdict"])
        writer.writerows(
            [*(f"{v:.6g}" if isinstance(v, float) else v for v in astuple(row)), verdict.words]
            for row in self.uncertainty.intervals
        )
        write_whole(folder / "intervals.csv", text.getvalue())

    def table(self) -> Table | None:
        """The intervals as the report shows them."""
        if self.uncertainty is None:
            return None
        rows = tuple((i.region, _words(i.figure), i.found, i.low, i.high) for i in self.uncertainty.intervals)
        columns = ("region", "figure", "as found", "95 % from", "to")
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
        The user's own or the preset's; None where there is neither.
    """
    grid = maps.grid
    try:
        chosen = _model_for(found, model)
        _refuse_unlabelled(found, subject)
        table = chosen.table_for(*_poorer(found))
    except InputError as reason:
        return ErrorBars(None, str(reason))
    bone, regions = _bone_and_tissues(subject, found.tissue.inside, table)
    if not bone.any():
        return ErrorBars(None, "The error depends on the distance to bone, and no bone was given.")
    to_bone = to_surface_mm(bone, grid.spacing_mm)
    sure = uncertainty_of(maps.max_shear, grid, regions, to_bone, table, seed=found.settings.seed)
    known = ", ".join(name for name in regions if name in table.whole and name != POOLED)
    voxel = " x ".join(f"{s:.2g}" for s in table.spacing_mm)
    told = (
        f"Error model of {chosen.preset} for voxels of {voxel} mm at SNR {table.snr:.0f}: "
        f"{chosen.source}. Tissues with figures of their own: {known or 'none'}; others take those of soft tissue "
        f"together. {_held(table)} All this is for tissue that is strained and imaged like those phantoms."
    )
    return ErrorBars(sure, told, replace(chosen, tables=(table,)))


def _held(table: ErrorTable) -> str:
    if not np.isfinite(table.widening):
        return "How often such intervals hold the truth is not known: the study has one heel alone."
    return (
        f"Intervals are {table.widening:.1f} times as wide as drawn, so that they held 95 % of the true figures when "
        "heels of the study were judged by the others."
    )


def _model_for(found: Registration, given: ErrorModel | None) -> ErrorModel:
    """The error model of what was used; InputError with the reason where there is none."""
    used = found.settings
    if len(used.presets) > 1:
        raise InputError("The error of several stages, one after the other, has not been measured.")
    if given is None:
        raise InputError(
            f"The error of {used.name} has not been measured; `mrstrain accuracy --preset {used.name}` does that."
        )
    if given.preset != used.name:
        raise InputError(
            f"The error model is that of {given.preset}, and {used.name} was used: `mrstrain accuracy --preset "
            f"{used.name}` measures that."
        )
    if given.parameters_sha256 != hashlib.sha256(used.text.encode()).hexdigest():
        raise InputError(_otherwise(used))
    if used.borders is not None and used.align_on != "bone":
        raise InputError(
            f"The error of {used.name} was measured with the bone held at rest; here nothing was aligned on a bone."
        )
    if found.choice is not None and found.choice.frees_volume:
        raise InputError(
            f"The error of {used.name} was measured on phantoms that keep their volume; here the images ask for a "
            "change of volume, which was allowed."
        )
    return given


def _refuse_unlabelled(found: Registration, subject: Subject) -> None:
    """Refuse a registration with borders of tissues of which a part has no label."""
    if found.settings.borders is None or subject.labels is None:
        return
    share = float(np.mean(subject.labels.labels[found.tissue.inside] == 0))
    if share > _UNLABELLED:
        raise InputError(
            f"{share:.0%} of the body has no label: the error of {found.settings.name} was measured on bodies of which "
            "every tissue has one. Label it, or take one smooth spline (--no-borders)."
        )


def _otherwise(used: Settings) -> str:
    """Why an error model of this engine or preset does not hold for these settings of it."""
    if used.gauss_newton is not None and used.gauss_newton.bending is not None:
        return (
            f"The error of {used.name} was measured with the weight of the bending chosen by its rule, as for a loaded "
            f"image; here it was fixed at {used.gauss_newton.bending:g}/mm, as for a repeat scan or by --bending."
        )
    return f"The error of {used.name} was measured with other parameters; `mrstrain accuracy` measures that of yours."


def _poorer(found: Registration) -> tuple[FloatArray, float]:
    """The larger voxel, edge by edge, and the lower signal-to-noise ratio of the two images."""
    spacing = np.maximum(np.sort(found.reference.grid.spacing_mm), np.sort(found.loaded.grid.spacing_mm))
    ratio = signal_to_noise(found.reference, found.tissue)
    try:
        return spacing, min(ratio, signal_to_noise(found.loaded, tissue_mask(found.loaded)))
    except InputError:  # no threshold finds the body there; the unloaded image has to do
        return spacing, ratio


def _bone_and_tissues(
    subject: Subject, tissue: BoolArray, table: ErrorTable
) -> tuple[BoolArray, Mapping[str, BoolArray]]:
    """Every bone that is known, and the soft tissues by name."""
    bone = np.zeros(tissue.shape, dtype=bool) if subject.bone is None else subject.bone.inside.copy()
    soft: dict[str, BoolArray] = {}
    if subject.labels is not None:
        for number, name in subject.labels.names.items():
            inside = subject.labels.labels == number
            count = np.count_nonzero(inside)
            words = set(re.split(r"[^a-z]+", name.lower()))
            named = bool(words & _BONES) and not words & _SOFT
            if named or (count and np.count_nonzero(inside & bone) > _MOSTLY * count):
                bone |= inside
            elif count:
                soft[name.lower() if name.lower() in table.whole else name] = inside
    if not soft:
        soft = {POOLED: tissue & ~bone}
    return bone, {name: inside & ~bone for name, inside in soft.items()}


def _words(figure: str) -> str:
    if figure.startswith("volume_above_"):
        return f"volume above {figure.removeprefix('volume_above_').removesuffix('_ml')}, mL"
    return {"median": "median", "p90": "90th percentile", "p95": "95th percentile"}[figure]
