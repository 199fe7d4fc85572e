"""The error bars of a registered load: its preset's error model put on its strain map."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.atomic_files import write_whole
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.images.image import Image
from dvc.images.noise import signal_to_noise
from dvc.images.tissue import tissue_mask
from dvc.io.images.write import write_image
from dvc.registration.register import Registration
from dvc.report import figures
from dvc.report.page import Picture, Table, caption_of
from dvc.report.planes import View
from dvc.trust.error_model import (
    POOLED,
    ErrorModel,
    ErrorTable,
    Interval,
    Uncertainty,
    to_surface_mm,
    uncertainty_of,
)
from dvc.trust.twin_judgement import Judged, judged
from dvc.trust.verdict import Verdict
from mrstrain.measurement.twin_check import TwinCheck
from mrstrain.records.inputs import Subject, is_bones_name

_MOSTLY = 0.5
_SIGMA_SCALE = 0.1
_TWIN = (
    "The unloaded image was moved by what was measured, its noise drawn anew, and the pair registered as the real one: "
    "its true strain is the one above. What came back tells what the noise and texture of these images cost. Strain "
    "that a registration smooths away before it is measured does not come back, which makes the twin's error smaller "
    "than the true one; what denoising takes of the texture makes it larger. A tissue in which fewer voxels lie within "
    "the claimed error than are expected of any registration, or a percentile does not come back within its interval, "
    "has its error bars made wider by the factor; none are made narrower."
)


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
    twin : tuple of Judged
        How the shear came back from the pair's twin, by tissue; empty where there is none.
    of_twin : str
        What it did to the error bars.
    """

    uncertainty: Uncertainty | None
    told: str
    model: ErrorModel | None = None
    twin: tuple[Judged, ...] = ()
    of_twin: str = ""

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        twin = (
            {"twin": [asdict(row) for row in self.twin], "of_twin": self.of_twin} if self.twin or self.of_twin else {}
        )
        if self.uncertainty is None:
            return {"known": False, "reason": self.told} | twin
        table = self.uncertainty.table
        voxel = table.spacing_mm.tolist()
        return {"known": True, "source": self.told, "voxel_mm": voxel, "snr": round(table.snr, 1)} | twin

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

    def tables(self) -> list[Table]:
        """The intervals, and what came back from the twin, as the report shows them."""
        tables = []
        if self.uncertainty is not None:
            rows = tuple((i.region, _words(i.figure), i.found, i.low, i.high) for i in self.uncertainty.intervals)
            columns = ("region", "figure", "as found", "95 % from", "to")
            tables.append(Table("Maximal shear with its error", columns, rows, self.told))
        if self.twin:
            claims = self.uncertainty is not None
            head = ("region", "error (rms)", "bias", *(("within the claim", "expected, at least", "wider") * claims))
            lines = tuple((row.region, row.rms_error, row.bias, *_against_claims(row)) for row in self.twin)
            tables.append(Table("The twin of this pair, measured again", head, lines, _TWIN))
        return tables

    def pictures(self, view: View, reference: Image) -> dict[str, Picture]:
        """The map of the standard deviation."""
        if self.uncertainty is None:
            return {}
        drawn = figures.sigma_slices(view, reference, self.uncertainty.sigma, _SIGMA_SCALE)
        return {"sigma": Picture("How sure the maximal shear is", caption_of(figures.sigma_slices), drawn)}


def error_bars(
    found: Registration,
    subject: Subject,
    maps: StrainMaps,
    model: ErrorModel | None,
    twin: TwinCheck | None = None,
) -> ErrorBars:
    """Error of a registered load's maximal shear.

    Parameters
    ----------
    model : ErrorModel or None
        The user's own or the preset's; None where there is neither.
    twin : TwinCheck or None
        The pair's twin: error bars that do not hold there are made wider.
    """
    grid = maps.grid
    bone, regions = _bone_and_tissues(subject, found.tissue.inside, model)
    try:
        chosen = _model_for(found, model)
        table = chosen.table_for(*_poorer(found))
        if not bone.any():
            raise InputError("The error depends on the distance to bone, and no bone was given.")
    except InputError as reason:
        again = None if twin is None else twin.max_shear
        rows = () if again is None else judged(maps.max_shear, again, regions)
        return ErrorBars(None, str(reason), twin=rows, of_twin=_of_twin(rows, twin))
    to_bone = to_surface_mm(bone, grid.spacing_mm)
    seed, rows = found.settings.seed, tuple[Judged, ...]()
    if twin is not None and twin.max_shear is not None:
        again = np.where(np.isfinite(maps.max_shear), twin.max_shear, np.float32(np.nan))
        of_twin = uncertainty_of(again, grid, regions, to_bone, table, seed=seed)
        rows = judged(maps.max_shear, again, regions, to_bone, of_twin, grid.voxel_volume_mm3)
    wider = {row.region: row.factor for row in rows if row.factor is not None and row.factor > 1.0}
    sure = uncertainty_of(maps.max_shear, grid, regions, to_bone, table, seed=seed, wider=wider)
    known = ", ".join(name for name in regions if name in table.whole and name != POOLED)
    voxel = " x ".join(f"{s:.2g}" for s in table.spacing_mm)
    told = (
        f"Error model of {chosen.preset} for voxels of {voxel} mm at SNR {table.snr:.0f}: "
        f"{chosen.source}. Tissues with figures of their own: {known or 'none'}; others take those of soft tissue "
        f"together. {_held(table)} All this is for tissue that is strained and imaged like those phantoms."
    )
    return ErrorBars(sure, told, _used(chosen, table, wider), rows, _of_twin(rows, twin))


def _used(chosen: ErrorModel, table: ErrorTable, wider: Mapping[str, float]) -> ErrorModel:
    """The one table that was used, for what compares models with the maps: as wide as its least sure tissue."""
    if not wider:
        return replace(chosen, tables=(table,))
    most = max(wider.values())
    source = f"{chosen.source}; intervals made {most:.1f} times wider by the twin of one pair, and for that pair alone"
    return replace(chosen, tables=(replace(table, widening=most * table.factor),), source=source)


def _of_twin(rows: Sequence[Judged], twin: TwinCheck | None) -> str:
    """What the pair's twin did to the error bars, or why there is none; empty where none was asked for."""
    if twin is not None and twin.failure:
        return f"there is no twin of this pair. {twin.failure}"
    if not rows:
        return ""
    if all(row.factor is None for row in rows):
        errors = ", ".join(f"{row.region} {row.rms_error:.3f}" for row in rows)
        return f"not known; the twin of this pair came back with an error (rms) of {errors}."
    some = ", ".join(f"{row.region} {row.factor:.1f} times" for row in rows if row.factor and row.factor > 1.0)
    return f"made wider by the twin of this pair: {some}." if some else "they hold in the twin of this pair."


def _held(table: ErrorTable) -> str:
    if not np.isfinite(table.widening):
        return "How often such intervals hold the truth is not known: the study has one heel alone."
    return (
        f"Intervals are {table.widening:.1f} times as wide as drawn, so that they held 95 % of the true figures when "
        "heels of the study were judged by the others."
    )


def _model_for(found: Registration, given: ErrorModel | None) -> ErrorModel:
    """The error model of what was used; InputError with the reason where there is none."""
    used = found.settings.engine
    if used.without_error_model:
        raise InputError(used.without_error_model)
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
        raise InputError(used.unlike_its_error_model)
    if found.unlike_study:
        raise InputError(found.unlike_study)
    return given


def _poorer(found: Registration) -> tuple[FloatArray, float]:
    """The larger voxel, edge by edge, and the lower signal-to-noise ratio of the two images."""
    spacing = np.maximum(np.sort(found.reference.grid.spacing_mm), np.sort(found.loaded.grid.spacing_mm))
    ratio = signal_to_noise(found.reference, found.tissue)
    try:
        return spacing, min(ratio, signal_to_noise(found.loaded, tissue_mask(found.loaded)))
    except InputError:  # no threshold finds the body there; the unloaded image has to do
        return spacing, ratio


def _bone_and_tissues(
    subject: Subject, tissue: BoolArray, model: ErrorModel | None
) -> tuple[BoolArray, Mapping[str, BoolArray]]:
    """Every bone that is known, and the soft tissues by name."""
    known = set() if model is None else set(model.tables[0].whole)
    bone = np.zeros(tissue.shape, dtype=bool) if subject.bone is None else subject.bone.inside.copy()
    soft: dict[str, BoolArray] = {}
    if subject.labels is not None:
        for number, name in subject.labels.names.items():
            inside = subject.labels.labels == number
            count = np.count_nonzero(inside)
            if is_bones_name(name) or (count and np.count_nonzero(inside & bone) > _MOSTLY * count):
                bone |= inside
            elif count:
                soft[name.lower() if name.lower() in known else name] = inside
    if not soft:
        soft = {POOLED: tissue & ~bone}
    return bone, {name: inside & ~bone for name, inside in soft.items()}


def _against_claims(row: Judged) -> tuple[str | float, ...]:
    """What the twin says of a tissue's error bars, as a table shows it; nothing where there are none."""
    if row.held is None or row.expected is None or row.factor is None:
        return ()
    return f"{row.held:.0%}", f"{row.expected:.0%}", row.factor


def _words(figure: str) -> str:
    if figure.startswith("volume_above_"):
        return f"volume above {figure.removeprefix('volume_above_').removesuffix('_ml')}, mL"
    return {"median": "median", "p90": "90th percentile", "p95": "95th percentile"}[figure]
