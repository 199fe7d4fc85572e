"""`compare`: finite-element models of any code against a measurement, load by load."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from dvc.arrays import FloatArray
from dvc.deformation import evaluate_on_grid
from dvc.errors import InputError
from dvc.image import Image, LabelMap
from dvc.imagewrite import write_image
from dvc.kinematics import StrainField, plate_axes
from dvc.labels import read_labels
from dvc.regions import volume_above
from dvc.report import Section, write_report
from dvc.viewer import Viewer
from dvc.whole import whole_file, whole_folder, write_whole
from fe.meshstore import read_tet_mesh
from mrstrain.comparepage import closing_sections, page_sections, pictures_of, shown, viewer_of
from mrstrain.inputs import make_output, refuse_touching_inputs
from mrstrain.measurements import Measurement, measurements_in
from mrstrain.methods import methods
from mrstrain.modelfiles import Reading, model_files
from mrstrain.page import flat
from mrstrain.provenance import provenance, versions, write_json
from validate.agreement import Agreement, Travel
from validate.comparison import Comparison, total
from validate.comparison import compare as compare_load
from validate.curves import RANGE, Area
from validate.levelled import LEVELLED
from validate.location import LEAST_ML, Overlap, read_thresholds
from validate.mapping import ALL
from validate.misfit import displacement_slip, misfits
from validate.sources import FeResult

Told = Callable[[str, str, float], None]

_TABLES = ("areas.csv", "location.csv", "agreement.csv", "travel.csv", "curves.csv")
_WHOLE = 0.9  # share of the mesh under which a model's cover is told
_MOST_STRAIN = 3.0
_STEP = 0.005  # of the curves that are written


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """What `compare` gave."""

    out: Path
    comparisons: tuple[Comparison, ...]
    totals: tuple[Area, ...]
    noise: tuple[str, ...]
    notes: tuple[str, ...]
    sections: tuple[Section, ...]
    closing: tuple[Section, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = []
        for one in self.comparisons:
            told = ", ".join(f"{a.model} {shown(a)}" for a in one.ranked())
            lines.append(f"{one.load}: area between the curves, mL, the nearest first: {told}")
            level = [a for a in one.areas if a.tissue == ALL and a.model.endswith(LEVELLED)]
            found = {a.model: a.ml for a in one.areas if a.tissue == ALL}
            lines += [
                f"{one.load}: {a.model} {a.ml:.2f} as found, {found.get(a.model.removesuffix(LEVELLED), np.nan):.2f} "
                "before levelling"
                for a in level
            ]
        if len(self.comparisons) > 1 and self.totals:
            lines.append("All loads: " + ", ".join(f"{a.model} {shown(a)}" for a in self.totals))
        return [*lines, *self.noise, *self.notes, f"Report: {self.out / 'report.html'}"]


def compare(
    dvc: Path | str,
    models: Sequence[Path | str],
    *,
    labels: Path | str,
    out: Path | str,
    names: Path | str | None = None,
    loads: Sequence[str] = (),
    bones: Sequence[str] = ("bone",),
    mesh: Path | str | None = None,
    model_mesh: Path | str | None = None,
    model_unit: str = "mm",
    model_frame: str = "LPS",
    to_image: FloatArray | None = None,
    plate_normal: Sequence[float] = (0.0, 0.0, -1.0),
    shear_direction: Sequence[float] = (0.0, -1.0, 0.0),
    strains: tuple[float, float] = RANGE,
    thresholds: Path | str | None = None,
    least_ml: float = LEAST_ML,
    on_image: bool = False,
    progress: Told | None = None,
) -> Compared:
    """Compare finite-element models with a measurement.

    Parameters
    ----------
    dvc : path
        Results of `register` or `strain`: a folder for each load, or one of these.
    models : sequence of path
        For each model a folder whose files are called as the loads (Load1.vtu, .vtk, .msh, .frd, or .csv with
        ``model_mesh``), or a file, where there is one load.
    labels, names : path
        Label map of the unloaded image and its names: tissues, and distance to bone.
    out : path
        Gets ``report.html``, tables, and a folder for each load.
    loads : sequence of str
        Names of measured loads; all by default.
    bones : sequence of str
        Labels of bone.
    mesh : path, optional
        Where fields are compared; the first model's mesh by default.
    model_mesh, model_unit, model_frame, to_image
        As in `validate.sources.read_result`.
    plate_normal, shear_direction : (3,)
        The plate's outward normal and the direction of shear, LPS.
    strains : (low, high)
        Range of maximal shear over which curves are compared.
    thresholds : path, optional
        Table of strains above which clusters are looked at, with where each comes from.
    least_ml : float
        Volume of the smallest cluster that counts.
    on_image : bool
        Also write each model's maximal shear on the measurement's voxels.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If measurement and models have no load in common, or as in `validate.comparison.compare`.
    """
    target, tell = Path(out), progress or (lambda *_: None)
    if not 0.0 <= strains[0] < strains[1] <= _MOST_STRAIN or least_ml < 0.0:
        raise InputError(
            f"The range of strain must rise from 0 or more to {_MOST_STRAIN:g} or less (no percent), and a volume be "
            f"0 or more; got {strains[0]:g} to {strains[1]:g}, {least_ml:g} mL."
        )
    axes = plate_axes(-np.asarray(plate_normal, dtype=np.float64), shear_direction)
    levels = read_thresholds(None if thresholds is None else Path(thresholds))
    tissues = read_labels(labels, names)
    measurements = measurements_in(Path(dvc), loads)
    usual = Reading(None if model_mesh is None else Path(model_mesh), model_unit, model_frame, to_image)
    places = [Path(m) for m in models]
    strange: list[str] = []
    files, notes = model_files([m.load for m in measurements], places, usual)
    every = [file for of in files.values() for file in of]
    given = [
        *(file.path for file in every),
        *dict.fromkeys(f.reading.mesh for f in every if f.reading.mesh is not None),
    ]
    refuse_touching_inputs(target, list(files), [*given, *(m.field for m in measurements), Path(labels)])
    for place in (Path(dvc), *(m.folder for m in measurements), *(p for p in places if p.is_dir())):
        if target.resolve() == place.resolve():
            raise InputError(f"{target} is a folder of results that are compared; choose another --out.")
    # Every file is looked at before anything is computed, and read again in its turn: together they fill the memory.
    for load, of in files.items():
        strange += [f"{load}: {told}" for file in of for told in misfits(file.read(tissues.grid), tissues, bones)]
    make_output(target)
    _clear(target, list(files))
    common = None if mesh is None else read_tet_mesh(mesh)
    record = provenance(
        "compare",
        {
            "measured": [m.field for m in measurements], "models": given, "labels": Path(labels),
            "names": [] if names is None else [Path(names)], "mesh": [] if mesh is None else [Path(mesh)],
            "error_models": [f for m in measurements if (f := m.folder / "error_model.json").is_file()],
        },
        {
            "bones": list(bones), "plate_axes_lps": axes.tolist(), "strains": list(strains),
            "least_cluster_ml": least_ml,
            "thresholds": [[t.max_shear, t.source] for t in levels],
            "model_unit": model_unit, "model_frame": model_frame,
            "to_image": None if to_image is None else np.asarray(to_image).tolist(), "seed": 1,
            "files": {load: {file.name: file.path.name for file in of} for load, of in files.items()},
        },
    )  # fmt: skip
    colours = list(dict.fromkeys(file.name for file in every))
    done: list[Comparison] = []
    told: list[tuple[Comparison, Measurement, dict[str, bytes], Viewer]] = []
    for number, measurement in enumerate(m for m in measurements if m.load in files):
        load = measurement.load
        tell("compare", "comparing", number / len(files))
        measured, results = measurement.deformation(), [file.read(tissues.grid) for file in files[load]]
        one = compare_load(
            load, measured, results, tissues, bones=bones, normal=-axes[:, 0], mesh=common,
            table=measurement.table, strains=strains, thresholds=levels, least_ml=least_ml,
        )  # fmt: skip
        strange += [f"{load}: {slip}" for name in one.found.models if (slip := displacement_slip(one.found, name))]
        drawn = pictures_of(one, measured, results, tissues, bones, axes, strains, colours)
        with whole_folder(target / load) as folder:
            _write_fields(folder / "fields.vtu", one)
            for stem, png in drawn.items():
                (folder / f"{stem}.png").write_bytes(png)
            if on_image:
                _write_on_image(folder, results, tissues)
            write_json(folder / "provenance.json", record)
        done.append(one)
        told.append((one, measurement, drawn, viewer_of(one, measured, results, tissues, bones, measurement.folder)))
    notes += strange
    notes += [
        f"{m.load}: the bone's motion was not taken out of this measurement: displacements are not the tissue's alone."
        for m in measurements
        if m.load in files and m.aligned_on == "none"
    ]
    notes += [
        f"{m.load}: how often its intervals hold is not known (an error model of one heel): they are as drawn."
        for m in measurements
        if m.load in files and m.table is not None and np.isnan(m.table.widening)
    ]
    unknown = [m.load for m in measurements if m.load in files and m.table is None]
    if unknown:
        notes.append(
            f"{', '.join(unknown)}: the measurement's error is not known (no error_model.json beside it): no "
            "difference counts as seen."
        )
    notes += _covered(done)
    totals, nothing, noise = total(done)
    _write_tables(target, done, [*totals, nothing], strains)
    write_json(
        target / "comparison.json",
        {
            "total_area_ml": {a.model: a.best_ml for a in totals}, "told_apart": list(noise), "notes": notes,
            "coverage_ml": {one.load: one.found.coverage() for one in done},
        } | record,
    )  # fmt: skip
    done_how = methods(
        {m.load: m.folder for m in measurements if m.load in files},
        {file.name: file.path for of in files.values() for file in of},
        len(done[0].found.points_mm), strains, [t.max_shear for t in levels], least_ml,
        error_known=any(one.bands for one in done), version=versions()["mrstrain"],
    )  # fmt: skip
    sections = page_sections(told, [*totals, nothing], noise, notes, strains)
    closing = closing_sections(levels, done_how)
    write_report(target / "report.html", "Models against the measurement", None, sections, closing, flat(record))
    tell("compare", "comparing", 1.0)
    return Compared(target, tuple(done), totals, noise, tuple(notes), tuple(sections), tuple(closing))


def _clear(target: Path, loads: Sequence[str]) -> None:
    """Remove what an earlier comparison wrote by its own list, but for the folders of loads that are made anew."""
    told = target / "comparison.json"
    try:
        old = list(json.loads(told.read_text(encoding="utf-8"))["coverage_ml"])
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in (*_TABLES, told.name, "report.html"):
        (target / name).unlink(missing_ok=True)
    for load in old:
        if load not in loads and (target / load / "fields.vtu").is_file():
            shutil.rmtree(target / load)


def _covered(done: Sequence[Comparison]) -> list[str]:
    """Which model leaves much of the mesh out: all are scored where every one is defined."""
    notes = []
    for one in done:
        volumes = one.found.coverage()
        for name in one.found.models:
            if volumes[name] < _WHOLE * volumes["mesh"]:
                notes.append(
                    f"{one.load}: {name} covers {volumes[name] / volumes['mesh']:.0%} of the mesh, and all models "
                    "are scored on the tissue that every one covers."
                )
    return notes


def _write_fields(path: Path, one: Comparison) -> None:
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


def _write_on_image(folder: Path, results: Sequence[FeResult], labels: LabelMap) -> None:
    inside = labels.labels > 0
    for result in results:
        values = np.full(labels.grid.shape, np.nan, dtype=np.float32)
        values[inside] = StrainField.from_gradient(
            evaluate_on_grid(result.deformation, labels.grid, inside)[1]
        ).max_shear
        write_image(folder / f"{result.name}_max_shear.nii.gz", Image(labels.grid, values))


def _write_tables(
    target: Path, done: Sequence[Comparison], totals: Sequence[Area], strains: tuple[float, float]
) -> None:
    _rows(target / "areas.csv", Area, [*(a for one in done for a in one.areas), *totals])
    _rows(target / "location.csv", Overlap, [o for one in done for o in one.overlaps])
    _rows(target / "agreement.csv", Agreement, [a for one in done for a in one.agreements])
    _rows(target / "travel.csv", Travel, [t for one in done for t in one.travels])
    at = np.arange(0.0, 1.5 * strains[1] + _STEP / 2, _STEP)
    curves: list[tuple[object, ...]] = []
    for one in done:
        found = one.found
        for tissue in (ALL, *found.tissues):
            where = found.common & ((found.tissue == tissue) | (tissue == ALL))
            if tissue in one.bands:
                band = one.bands[tissue]
                for name, edge in (("measured, low", band.low_ml), ("measured, high", band.high_ml)):
                    curves += [
                        (one.load, tissue, name, s, v)
                        for s, v in zip(at.tolist(), np.interp(at, band.strains, edge).tolist(), strict=True)
                    ]
            for name, field in {"measured": found.measured, **found.models}.items():
                above = volume_above(field.max_shear[where], found.volumes_ml[where], at)
                curves += [(one.load, tissue, name, s, v) for s, v in zip(at.tolist(), above.tolist(), strict=True)]
    write_whole(target / "curves.csv", _table(["load", "tissue", "field", "max_shear", "volume_above_ml"], curves))


def _rows(path: Path, kind: type[Any], rows: Sequence[Any]) -> None:
    write_whole(path, _table([f.name for f in fields(kind)], [astuple(row) for row in rows]))


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)
    return text.getvalue()
