"""Errors of a measured strain and displacement: bias and standard deviation, measured on phantoms.

An error model is made by an accuracy study of one registration preset: of voxels in which a maximum shear strain m was
measured, by tissue and distance to bone, how far it lay from the truth on average (bias) and how much that varied
(standard deviation), for each registration of the study and for all together; and the same for the components of the
strain and of the displacement. Given m, the truth is then about m - bias, with that deviation. This holds for tissue
that is strained and imaged like the study's phantoms, and for no other.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.atomic_files import write_whole
from dvc.errors import InputError
from dvc.file_names import as_typed
from dvc.own_files import read_json
from dvc.trust.quality import plain

POOLED = "soft tissue"
"""Name of the row for tissue that the study did not have, or that has no label."""

ROWS = ("bias", "sd", "shrinkage", "sd_normal", "sd_shear", "sd_displacement_mm")
"""Figures of a table: bias and standard deviation of the maximum shear strain; mean error of the Green-Lagrange strain
as a fraction of it, and standard deviation about that of a normal and of a shear component; standard deviation of a
component of the displacement, mm. The components' values are the same in all axes."""

_FORMAT = 2
_FORMER = 1  # without components
_FAR = 1.6  # a table is used for voxels and noise within this factor of its own
_BEYOND = 1.2  # beyond this factor, readers of the error bars are told


@dataclass(frozen=True, slots=True, eq=False)
class ErrorTable:
    """Errors for one voxel size and `dvc.images.noise.signal_to_noise`.

    They are given at rising measured maximum shear strains (m,), linear between and constant beyond, and for bins of
    distance to bone whose lower ends (k,) rise from 0: `ROWS` (6, k, m), of measured minus true values, by tissue, over
    the whole study and in each of its runs (registrations), since errors differ from image to image. Models without
    components have the first two rows only.
    """

    spacing_mm: FloatArray
    snr: float
    shear: FloatArray
    to_bone_mm: FloatArray
    whole: Mapping[str, FloatArray]
    runs: tuple[Mapping[str, FloatArray], ...]
    correlation_mm: float  # distance at which the autocorrelation of the shear's error has fallen to 1/e
    # Factor on intervals as drawn, by which 95 % of the tissues' statistics lay in them when each motion of the study
    # was judged by the others; NaN where there was one motion and one heel alone, and intervals stay as drawn.
    widening: float = float("nan")
    widening_of: Mapping[str, float] = field(default_factory=dict)  # the same of one tissue, where it is known
    # The same distance for the errors of a component of the strain and of the displacement.
    component_correlation_mm: tuple[float, float] = (float("nan"), float("nan"))
    # By tissue, the fraction of the variance of a component's error that is the same in all voxels of a registration,
    # (2,): of the strain and of the displacement.
    shared: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def factor(self) -> float:
        """`widening`, and 1 where it is not known."""
        return 1.0 if np.isnan(self.widening) else self.widening

    def factor_of(self, tissue: str) -> float:
        """The factor of a tissue, and `factor` where it is not known."""
        return self.widening_of.get(tissue.lower(), self.factor)

    def shared_of(self, tissue: str) -> FloatArray:
        """`shared` (2,) of a tissue, that of all soft tissue where it is not known, or zeros."""
        return self.shared.get(tissue.lower(), self.shared.get(POOLED, np.zeros(2)))

    @property
    def has_components(self) -> bool:
        """Whether errors of the components of strain and displacement are known."""
        return len(self.whole[POOLED]) == len(ROWS)

    def far(self, spacing_mm: FloatArray, snr: float) -> float:
        """The factor between its voxel's edges or SNR and those of images, whichever is largest; 1 or more."""
        voxel = np.abs(np.log(np.sort(spacing_mm) / np.sort(self.spacing_mm))).max()
        return float(np.exp(max(voxel, abs(np.log(snr / self.snr)))))

    def beyond(self, spacing_mm: FloatArray, snr: float, preset: str) -> str:
        """Two sentences if voxels (3,) mm or SNR of images differ from its own by more than a factor of 1.2.

        The second says how the errors of the ``preset`` are measured for these images.
        """
        if self.far(spacing_mm, snr) <= _BEYOND:
            return ""
        return (
            f"The error bars were measured on phantoms (voxels of {_told(self.spacing_mm)} mm, SNR {self.snr:.0f}); "
            f"these images have {_told(spacing_mm)} mm and SNR {snr:.0f}, so they may cover more or less than 95 %. "
            f"Measure yours with {_measuring(preset, spacing_mm, snr)}"
        )

    def expected(
        self, tissue: str, shear: FloatArray, to_bone_mm: Float32Array, run: int | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Bias and standard deviation (n,) of shears (n,) measured in a tissue at distances (n,) mm from bone.

        Over all registrations, or in the one numbered ``run``.
        """
        bias, sd = self._rows(tissue, shear, to_bone_mm, run, slice(2))
        return bias, sd

    def expected_components(
        self, tissue: str, shear: FloatArray, to_bone_mm: Float32Array, run: int | None = None
    ) -> FloatArray:
        """The rows (4, n) of `ROWS` on components of strain and displacement, as `expected`."""
        return self._rows(tissue, shear, to_bone_mm, run, slice(2, None))

    def _rows(
        self, tissue: str, shear: FloatArray, to_bone_mm: Float32Array, run: int | None, which: slice
    ) -> FloatArray:
        cells = self.whole if run is None else self.runs[run]
        rows = cells[tissue if tissue in cells else POOLED][which]
        bins = np.clip(np.searchsorted(self.to_bone_mm, to_bone_mm, side="right") - 1, 0, len(self.to_bone_mm) - 1)
        found = np.empty((len(rows), len(shear)))
        for k in range(len(self.to_bone_mm)):
            here = bins == k
            at = shear[here]
            for out, row in zip(found, rows, strict=True):
                out[here] = np.interp(at, self.shear, row[k])
        return found


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Error tables of one preset, what they were made from, and the study in a sentence (``source``)."""

    preset: str
    parameters_sha256: str  # of the preset's text: other parameters under the same name have another error
    tables: tuple[ErrorTable, ...]
    source: str

    def table_for(self, spacing_mm: FloatArray, snr: float) -> ErrorTable:
        """The closest table to a voxel (3,) mm and an SNR: sorted edges and SNR each within a factor of 1.6.

        InputError if no table is that close; the message gives the closest.
        """
        nearest = min(self.tables, key=lambda table: table.far(spacing_mm, snr))
        if not nearest.far(spacing_mm, snr) <= _FAR:
            raise InputError(
                f"The error of {self.preset} is not known for voxels of {_told(spacing_mm)} mm at SNR {snr:.0f}: the "
                f"closest known, {_told(nearest.spacing_mm)} mm at SNR {nearest.snr:.0f}, is too far. Measure it with "
                f"`mrstrain accuracy --preset {as_typed(self.preset)}` (--spacing, --snr); give its file as "
                "error_model (--error-model)."
            )
        return nearest

    def write(self, path: Path) -> None:
        """Write as JSON, whole or not at all."""

        def rounded(cells: Mapping[str, FloatArray]) -> dict[str, object]:
            return {tissue: np.round(rows, 4).tolist() for tissue, rows in cells.items()}

        told = {name: getattr(self, name) for name in ("preset", "parameters_sha256", "source")}
        tables = [
            {"spacing_mm": t.spacing_mm.tolist(), "snr": t.snr, "shear": t.shear.tolist()}
            | {"to_bone_mm": t.to_bone_mm.tolist(), "errors": rounded(t.whole)}
            | {"errors_of_each_run": [rounded(run) for run in t.runs]}
            | {"correlation_mm": t.correlation_mm, "widening": plain(t.widening)}
            | {"widening_of": dict(t.widening_of), "shared": rounded(t.shared)}
            | {"component_correlation_mm": [plain(length) for length in t.component_correlation_mm]}
            for t in self.tables
        ]
        write_whole(path, json.dumps({"format": _FORMAT, **told, "tables": tables}, allow_nan=False) + "\n")


def read_error_model(path: Path | str) -> ErrorModel:
    """Read a file of `ErrorModel.write`; InputError if it cannot be read or is not an error model."""
    try:
        return _parsed(read_json(Path(path)))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as failure:
        what = f"not an error model written by `mrstrain accuracy` ({type(failure).__name__}: {failure})."
        raise InputError(f"{path}: {what}") from failure


@cache
def error_model_of(preset: str) -> ErrorModel | None:
    """The error model that comes with a named preset; None where there is none."""
    stored = files("dvc.trust") / "error_models" / f"{preset}.json"
    return _parsed(json.loads(stored.read_text(encoding="utf-8"))) if stored.is_file() else None


def _parsed(told: Mapping[str, Any]) -> ErrorModel:
    if told["format"] not in {_FORMAT, _FORMER}:
        raise ValueError(f"the format is {told['format']}; {_FORMAT} is needed")
    name = "errors" if told["format"] == _FORMAT else "bias_and_sd"

    def cells(given: Mapping[str, list[object]]) -> dict[str, FloatArray]:
        return {tissue: np.asarray(rows, dtype=np.float64) for tissue, rows in given.items()}

    def number(given: float | None) -> float:
        return float(np.nan if given is None else given)

    tables = tuple(
        ErrorTable(
            snr=float(t["snr"]),
            whole=cells(t[name]),
            runs=tuple(cells(run) for run in t[f"{name}_of_each_run"]),
            correlation_mm=float(t["correlation_mm"]),
            widening=number(t["widening"]),
            shared=cells(t.get("shared", {})),
            widening_of={tissue: number(factor) for tissue, factor in t.get("widening_of", {}).items()},
            component_correlation_mm=(number(lengths[0]), number(lengths[1])),
            **{name: np.asarray(t[name], dtype=np.float64) for name in ("spacing_mm", "shear", "to_bone_mm")},
        )
        for t in told["tables"]
        for lengths in [t.get("component_correlation_mm", (None, None))]
    )
    if not tables or any(POOLED not in cells for t in tables for cells in (t.whole, *t.runs)):
        raise ValueError(f"it has no table, or a table without a row '{POOLED}'")
    for t in tables:
        shape = (len(ROWS) if t.has_components else 2, len(t.to_bone_mm), len(t.shear))
        figures = (rows for cells in (t.whole, *t.runs) for rows in cells.values())
        sound = (
            rows.shape == shape and np.isfinite(rows).all() and (rows[[1, *range(3, shape[0])]] >= 0).all()
            for rows in figures
        )
        if not (t.runs and all(sound)):
            raise ValueError(f"a table has no runs, or its statistics are not {shape} finite numbers")
        if t.has_components and not all(length > 0 for length in t.component_correlation_mm):
            raise ValueError("it has no correlation length of the components")
        if not all(factor >= 1.0 for factor in t.widening_of.values()):
            raise ValueError("a widening of a tissue is below 1")
        if not all(of.shape == (2,) and ((of >= 0.0) & (of <= 1.0)).all() for of in t.shared.values()):
            raise ValueError("a shared fraction is not two numbers from 0 to 1")
        rising = np.all(np.diff(t.shear) > 0) and np.all(np.diff(t.to_bone_mm) > 0)
        if not (rising and t.spacing_mm.shape == (3,) and min(*t.spacing_mm, t.snr, t.correlation_mm) > 0):
            raise ValueError("a voxel size, SNR or bin is not positive, or the bins do not increase")
    return ErrorModel(str(told["preset"]), str(told["parameters_sha256"]), tables, str(told["source"]))


def _measuring(preset: str, spacing_mm: FloatArray, snr: float) -> str:
    """How an error model is made for voxels (3,) mm and an SNR, as the end of a sentence."""
    short, plane, long = np.sort(spacing_mm)  # two edges or more are alike
    across = max(short, long, key=lambda edge: abs(np.log(edge / plane)))
    slices = f" --slice-spacing {across:.2g}" if abs(np.log(across / plane)) > 0.01 else ""
    command = f"mrstrain accuracy --preset {as_typed(preset)} --spacing {plane:.2g}{slices} --snr {snr:.0f} --out DIR"
    return f"`{command}`; give its file as --error-model."


def _told(spacing_mm: FloatArray) -> str:
    return " x ".join(f"{s:.2g}" for s in spacing_mm[: 1 if np.ptp(spacing_mm) < 1e-6 else 3])
