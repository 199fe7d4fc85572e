"""The files of a comparison: tables of all results, fields on the mesh, and maps on the voxels of the image."""

import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

import meshio
import numpy as np

from dvc import Image, StrainField, evaluate_on_grid, write_image, write_vectors
from dvc.arrays import FloatArray
from dvc.atomic_files import whole_file, write_csv
from dvc.errors import InputError
from dvc.file_names import as_file_name
from dvc.own_files import read_json, read_rows
from dvc.report.drawing import Columns, figure_files
from validate.agreement import Agreement, SkinDisplacement
from validate.comparison_error import ComparisonError
from validate.curves import Area
from validate.decomposition import Representation
from validate.load_comparison import LoadComparison
from validate.location import Overlap
from validate.mapping import ALL
from validate.mavm import ModelForm

RECORD = "comparison.json"
TABLES = {
    "areas.csv": Area, "location.csv": Overlap, "agreement.csv": Agreement,
    "skin_displacement.csv": SkinDisplacement, "decomposition.csv": Representation, "mavm.csv": ModelForm,
    "comparison_error.csv": ComparisonError,
}  # fmt: skip
_LATER = (Representation, ModelForm, ComparisonError)  # older comparisons have no such table
_BEFORE = {"skin_displacement.csv": "travel.csv"}  # names in older comparisons
CURVES = "curves.csv"
OF_ALL_LOADS = ("slices_by_load", "curves_by_load")
"""Stems of the figures under all loads."""
LOWER, UPPER = "measured, low", "measured, high"
"""Names of the curves that bound the 95 % band of the true curve."""
_CURVE_COLUMNS = ("load", "tissue", "field", "max_shear", "volume_above_ml")
_STEP = 0.005  # of strain, in written curves


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A strain-volume curve: the volume of tissue that exceeds each maximum shear strain, (k,).

    ``field`` is "measured", a model, or an edge of the 95 % band of the true curve: "measured, low", "measured, high".
    """

    load: str
    tissue: str
    field: str
    max_shear: FloatArray
    volume_above_ml: FloatArray


def curves_of(one: LoadComparison, strains: FloatArray | None = None) -> list[Curve]:
    """The curves of one load at strains (k,), by default from 0 to one and a half times the upper end of the range."""
    at = np.arange(0.0, 1.5 * one.criteria.strains[1] + _STEP / 2, _STEP) if strains is None else strains
    made = []
    for tissue in (ALL, *one.fields.tissues):
        volumes = one.fields.curves(tissue, at)
        if band := one.bands.get(tissue):
            edges = {LOWER: band.low_ml, UPPER: band.high_ml}
            volumes = {name: np.interp(at, band.strains, edge) for name, edge in edges.items()} | volumes
        made += [Curve(one.load, tissue, name, at, above) for name, above in volumes.items()]
    return made


def write_tables(
    folder: Path, tables: Sequence[Sequence[Any]], curves: Iterable[Curve], verdicts: Mapping[str, str]
) -> None:
    """Write the rows of each of the `TABLES`, in their order, and a row for each point of the curves.

    Each row has the verdict on its load; empty if there is none.
    """
    for (name, kind), rows in zip(TABLES.items(), tables, strict=True):
        head = [*(f.name for f in fields(kind)), "verdict"]
        write_csv(folder / name, head, ((*astuple(row), verdicts.get(row.load, "")) for row in rows))
    points = columns_of(curves)
    verdict = (verdicts.get(str(load), "") for load in points["load"])
    write_csv(folder / CURVES, [*points, "verdict"], zip(*points.values(), verdict, strict=True))


def columns_of(curves: Iterable[Curve]) -> Columns:
    """The points of curves one below the other; also the data of figures that show them."""
    points = [
        (c.load, c.tissue, c.field, strain, volume)
        for c in curves
        for strain, volume in zip(c.max_shear.tolist(), c.volume_above_ml.tolist(), strict=True)
    ]
    return dict(zip(_CURVE_COLUMNS, zip(*points, strict=True), strict=True))


def read_tables(folder: Path) -> list[tuple[Any, ...]]:
    """Rows of each of the `TABLES`, to the six digits of the file; InputError if a file is not such a table."""
    tables: list[tuple[Any, ...]] = []
    for name, kind in TABLES.items():
        path = folder / name
        if name in _BEFORE and not path.is_file():
            path = folder / _BEFORE[name]
        readers = get_type_hints(kind)  # int, float or str
        if kind in _LATER and not path.is_file():
            tables.append(())
            continue
        rows = _rows(path, readers)
        with _damage_named(path):
            tables.append(tuple(kind(**{of: read(row[of]) for of, read in readers.items()}) for row in rows))
    return tables


def read_curves(folder: Path) -> tuple[Curve, ...]:
    """Read the curves of `write_tables`; errors as `read_tables`."""
    points: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for row in _rows(folder / CURVES, _CURVE_COLUMNS):
        key = row["load"], row["tissue"], row["field"]
        with _damage_named(folder / CURVES):
            points.setdefault(key, []).append((float(row["max_shear"]), float(row["volume_above_ml"])))
    return tuple(Curve(*key, *np.array(of).T) for key, of in points.items())


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """InputError that names a table in which a number is none."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{path}: the table of the comparison is damaged ({error}). Compare again.") from error


def _rows(path: Path, columns: Iterable[str]) -> list[dict[str, str]]:
    try:
        rows = read_rows(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the table of the comparison cannot be read ({error}). Compare again.") from error
    missing = [name for name in columns if rows and name not in rows[0]]
    if missing:
        raise InputError(
            f"{path} has no column {missing[0]}; the comparison was written by another version. Compare again."
        )
    return rows


def remove_earlier(folder: Path, loads: Sequence[str]) -> None:
    """Remove the files of an earlier comparison, and its folders of loads that are no longer compared."""
    try:
        earlier = [as_file_name(load) for load in read_json(folder / RECORD)["coverage_ml"]]
    except (OSError, ValueError, KeyError, TypeError):
        return
    pictures = (path for stem in OF_ALL_LOADS for path in (*figure_files(folder / stem), folder / f"{stem}.csv"))
    for path in (*(folder / name for name in (*TABLES, *_BEFORE.values(), CURVES, RECORD, "report.html")), *pictures):
        path.unlink(missing_ok=True)
    for load in earlier:
        if load not in loads and (folder / load / "fields.vtu").is_file():
            shutil.rmtree(folder / load)


def write_fields(path: Path, one: LoadComparison) -> None:
    """Write measured and simulated maximum shear strain and displacement in the compared cells, for ParaView."""
    mapped, arrays = one.fields, dict[str, list[FloatArray]]()
    for name, field in mapped.by_name.items():
        arrays |= {f"{name}_max_shear": [field.max_shear], f"{name}_u_mm": [field.u_mm]}
    arrays |= {"to_bone_mm": [mapped.to_bone_mm]} if one.bones else {}
    arrays["compared"] = [mapped.common.astype(np.float64)]
    mesh = meshio.Mesh(mapped.mesh.points_mm, [("tetra", mapped.mesh.cells)], cell_data=arrays)
    with whole_file(path) as part:
        meshio.vtu.write(part, mesh, binary=True)


def write_on_image(folder: Path, one: LoadComparison) -> None:
    """Write displacement and max. shear of each model on the voxels of the label map; NaN outside labels or model."""
    grid, inside = one.labels.grid, one.labels.labels > 0
    for result in one.case.read()[1]:
        u = np.full((*grid.shape, 3), np.nan, dtype=np.float32)
        shear = np.full(grid.shape, np.nan, dtype=np.float32)
        u[inside], H = evaluate_on_grid(result.deformation, grid, inside)
        shear[inside] = StrainField.from_gradient(H).max_shear
        write_image(folder / f"{result.name}_max_shear.nii.gz", Image(grid, shear))
        about = f"displacement u(X) of tissue in the model {result.name}"
        write_vectors(folder / f"{result.name}_displacement.nii.gz", grid, u, ("x", "y", "z"), about, "LPS", unit="mm")
