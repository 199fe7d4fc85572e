"""The files of a comparison: tables of every figure, fields on the mesh, and maps on the image's voxels."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from dvc.arrays import FloatArray
from dvc.atomic_files import whole_file, write_whole
from dvc.deformation.protocol import evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.images.image import Image, LabelMap
from dvc.io.images.write import write_image, write_vectors
from dvc.io.result_folder import REPORT
from validate.agreement import Agreement, Travel
from validate.comparison import Comparison
from validate.curves import Area
from validate.fe_result import FeResult
from validate.location import Overlap
from validate.mapping import ALL

_TABLES = ("areas.csv", "location.csv", "agreement.csv", "travel.csv", "curves.csv")
_STEP = 0.005  # of the curves that are written


def clear_earlier(target: Path, loads: Sequence[str]) -> None:
    """Remove what an earlier comparison wrote by its own list, but for the folders of loads that are made anew."""
    told = target / "comparison.json"
    try:
        old = list(json.loads(told.read_text(encoding="utf-8"))["coverage_ml"])
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in (*_TABLES, told.name, REPORT):
        (target / name).unlink(missing_ok=True)
    for load in old:
        if load not in loads and (target / load / "fields.vtu").is_file():
            shutil.rmtree(target / load)


def write_fields(path: Path, one: Comparison) -> None:
    """Measured and simulated maximal shear and displacement in the compared cells, for ParaView."""
    found = one.found
    arrays: dict[str, FloatArray] = {
        "measured_max_shear": found.measured.max_shear,
        "measured_u_mm": found.measured.u_mm,
    }
    for name, field in found.models.items():
        arrays |= {f"{name}_max_shear": field.max_shear, f"{name}_u_mm": field.u_mm}
    arrays["to_bone_mm"] = found.to_bone_mm
    arrays["compared"] = found.common.astype(np.float64)
    mesh = meshio.Mesh(
        found.mesh.points_mm, [("tetra", found.mesh.cells)], cell_data={n: [a] for n, a in arrays.items()}
    )
    with whole_file(path) as part:
        meshio.vtu.write(part, mesh, binary=True)


def write_on_image(folder: Path, results: Sequence[FeResult], labels: LabelMap) -> None:
    """Each model's displacement and maximal shear on the label map's voxels; NaN outside the labels or the model."""
    inside = labels.labels > 0
    for result in results:
        u = np.full((*labels.grid.shape, 3), np.nan, dtype=np.float32)
        shear = np.full(labels.grid.shape, np.nan, dtype=np.float32)
        u[inside], H = evaluate_on_grid(result.deformation, labels.grid, inside)
        shear[inside] = StrainField.from_gradient(H).max_shear
        write_image(folder / f"{result.name}_max_shear.nii.gz", Image(labels.grid, shear))
        write_vectors(
            folder / f"{result.name}_displacement.nii.gz", labels.grid, u, ("x", "y", "z"),
            f"displacement u(X) of tissue in the model {result.name}", "LPS", unit="mm",
        )  # fmt: skip


def write_tables(
    target: Path,
    done: Sequence[Comparison],
    totals: Sequence[Area],
    strains: tuple[float, float],
    levels: Mapping[str, str],
) -> None:
    """Every figure by load, each row with the verdict on its load's registration (``levels``; empty: none is known)."""
    _rows(target / "areas.csv", Area, [*(a for one in done for a in one.areas), *totals], levels)
    _rows(target / "location.csv", Overlap, [o for one in done for o in one.overlaps], levels)
    _rows(target / "agreement.csv", Agreement, [a for one in done for a in one.agreements], levels)
    _rows(target / "travel.csv", Travel, [t for one in done for t in one.travels], levels)
    at = np.arange(0.0, 1.5 * strains[1] + _STEP / 2, _STEP)
    curves: list[tuple[object, ...]] = []
    for one in done:
        found = one.found
        for tissue in (ALL, *found.tissues):
            if tissue in one.bands:
                band = one.bands[tissue]
                for name, edge in (("measured, low", band.low_ml), ("measured, high", band.high_ml)):
                    curves += [
                        (one.load, tissue, name, s, v)
                        for s, v in zip(at.tolist(), np.interp(at, band.strains, edge).tolist(), strict=True)
                    ]
            for name, above in found.curves(tissue, at).items():
                curves += [(one.load, tissue, name, s, v) for s, v in zip(at.tolist(), above.tolist(), strict=True)]
    told = [(*row, levels.get(str(row[0]), "")) for row in curves]
    write_whole(
        target / "curves.csv", _table(["load", "tissue", "field", "max_shear", "volume_above_ml", "verdict"], told)
    )


def _rows(path: Path, kind: type[Any], rows: Sequence[Any], levels: Mapping[str, str]) -> None:
    head = [*(f.name for f in fields(kind)), "verdict"]
    write_whole(path, _table(head, [(*astuple(row), levels.get(row.load, "")) for row in rows]))


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)
    return text.getvalue()
