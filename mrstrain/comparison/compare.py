"""`compare`: finite-element models of any code against a measurement, load by load."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.atomic_files import whole_folder, write_json
from dvc.deformation.strain import plate_axes
from dvc.errors import InputError
from dvc.io.images.labels import read_labels
from dvc.io.result_folder import ERROR_MODEL, PROVENANCE, REPORT, ResultFolder, result_folders
from dvc.report.page import Picture, Section, write_report
from dvc.report.viewer import Viewer
from dvc.trust.verdict import Verdict, verdict_on_loads
from fe.mesh_file import read_tet_mesh
from mrstrain.comparison.methods import methods
from mrstrain.comparison.model_files import Reading, model_files
from mrstrain.comparison.page import closing_sections, page_sections, pictures_of, shown, viewer_of
from mrstrain.comparison.result_files import clear_earlier, write_fields, write_on_image, write_tables
from mrstrain.measurement.page import flat
from mrstrain.models.loads import Vector
from mrstrain.records.inputs import make_output, refuse_touching_inputs
from mrstrain.records.provenance import provenance, versions
from validate.comparison import ALL_LOADS, Comparison, total
from validate.comparison import compare as compare_load
from validate.curves import RANGE, Area, check_range
from validate.extrapolation import LEVELLED
from validate.fe_result import check_overlap
from validate.location import LEAST_ML, read_thresholds
from validate.mapping import ALL, check_bones
from validate.misfit import check_in_tissue, displacement_slip, misfits

Told = Callable[[str, str, float], None]

_WHOLE = 0.9  # share of the mesh under which a model's cover is told


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """What `compare` gave.

    Attributes
    ----------
    out : Path
    comparisons : tuple of Comparison
        By load.
    totals : tuple of Area
        Over all loads, the nearest model first.
    noise, notes : tuple of str
        Which models the measurement tells apart; and what is to be known beside.
    verdict : Verdict or None
        On the registrations, and on slips of the models; None where nothing is known.
    sections, closing : tuple of Section
        Of the report.
    """

    out: Path
    comparisons: tuple[Comparison, ...]
    totals: tuple[Area, ...]
    noise: tuple[str, ...]
    notes: tuple[str, ...]
    verdict: Verdict | None
    sections: tuple[Section, ...]
    closing: tuple[Section, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = [] if self.verdict is None else [f"Verdict on what was given: {self.verdict.words}"]
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
        return [*lines, *self.noise, *self.notes, f"Report: {self.out / REPORT}"]


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
    towards: Mapping[str, tuple[Vector, Vector]] | None = None,
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
        As in `validate.fe_result.read_result`.
    plate_normal, shear_direction : (3,)
        The plate's outward normal and the direction of shear, LPS.
    towards : mapping, optional
        The same two for loads, by name, that went in directions of their own.
    strains : (low, high)
        Range of maximal shear over which curves are compared.
    thresholds : path, optional
        Table of strains above which clusters are looked at, with where each comes from.
    least_ml : float
        Volume of the smallest cluster that counts.
    on_image : bool
        Also write each model's displacement and maximal shear on the voxels of the label map.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If measurement and models have no load in common, or as in `validate.comparison.compare`.
    """
    target, tell = Path(out), progress or (lambda *_: None)
    check_range(strains)
    if least_ml < 0.0:
        raise InputError(f"The smallest cluster's volume must be 0 or more; got {least_ml:g} mL.")
    usual_axes = plate_axes(-np.asarray(plate_normal, dtype=np.float64), shear_direction)
    own_axes = {load: plate_axes(-np.asarray(away), along) for load, (away, along) in (towards or {}).items()}
    thresholds_used = read_thresholds(None if thresholds is None else Path(thresholds))
    tissues = read_labels(labels, names)
    measurements = result_folders(Path(dvc), loads)
    usual = Reading(None if model_mesh is None else Path(model_mesh), model_unit, model_frame, to_image)
    places = [Path(m) for m in models]
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
    # Every file is looked at before anything is computed or removed, and read again in its turn: together they fill
    # the memory.
    check_bones(tissues, bones)
    common = None if mesh is None else read_tet_mesh(mesh)
    if mesh is not None and common is not None:
        check_overlap(Path(mesh), common, tissues.grid)
        check_in_tissue(Path(mesh), common, tissues, bones)
    compared = [m for m in measurements if m.load in files]
    for measurement in compared:
        measurement.deformation()
    strange = [
        f"{load}: {odd}"
        for load, of in files.items()
        for file in of
        for odd in misfits(file.read(tissues.grid), tissues, bones)
    ]
    make_output(target)
    clear_earlier(target, list(files))
    record = provenance(
        "compare",
        {
            "measured": [f for m in measurements for f in m.files], "models": given, "labels": Path(labels),
            "names": [] if names is None else [Path(names)], "mesh": [] if mesh is None else [Path(mesh)],
            "error_models": [f for m in measurements if (f := m.folder / ERROR_MODEL).is_file()],
        },
        {
            "bones": list(bones), "plate_axes_lps": usual_axes.tolist(), "strains": list(strains),
            "plate_axes_lps_of": {load: own.tolist() for load, own in own_axes.items()},
            "least_cluster_ml": least_ml,
            "thresholds": [[t.max_shear, t.source] for t in thresholds_used],
            "model_unit": model_unit, "model_frame": model_frame,
            "to_image": None if to_image is None else np.asarray(to_image).tolist(), "seed": 1,
            "files": {load: {file.name: file.path.name for file in of} for load, of in files.items()},
        },
    )  # fmt: skip
    colours = list(dict.fromkeys(file.name for file in every))
    done: list[Comparison] = []
    told: list[tuple[Comparison, ResultFolder, dict[str, Picture], Viewer]] = []
    for number, measurement in enumerate(compared):
        load = measurement.load
        axes = own_axes.get(load, usual_axes)
        tell("compare", "comparing", number / len(files))
        measured, results = measurement.deformation(), [file.read(tissues.grid) for file in files[load]]
        one = compare_load(
            load, measured, results, tissues, bones=bones, normal=-axes[:, 0], mesh=common,
            table=measurement.table, strains=strains, thresholds=thresholds_used, least_ml=least_ml,
        )  # fmt: skip
        strange += [f"{load}: {slip}" for name in one.found.models if (slip := displacement_slip(one.found, name))]
        drawn = pictures_of(one, measured, results, tissues, bones, axes, strains, colours)
        with whole_folder(target / load) as folder:
            write_fields(folder / "fields.vtu", one)
            for stem, picture in drawn.items():
                (folder / f"{stem}.png").write_bytes(picture.png)
            if on_image:
                write_on_image(folder, results, tissues)
            write_json(folder / PROVENANCE, record | {"verdict": _plain(measurement.verdict)})
        done.append(one)
        told.append((one, measurement, drawn, viewer_of(one, measured, results, tissues, bones, measurement.folder)))
    verdicts = {m.load: m.verdict for m in compared if m.verdict is not None}
    verdict = verdict_on_loads(verdicts, strange)
    doubts = () if verdict is None or verdict.level == "trust" else verdict.reasons
    notes += doubts
    notes += [
        f"{m.load}: the bone's motion was not taken out of this measurement: displacements are not the tissue's alone."
        for m in compared
        if m.aligned_on == "none"
    ]
    notes += [
        f"{m.load}: how often its intervals hold is not known (an error model of one heel): they are as drawn."
        for m in compared
        if m.table is not None and np.isnan(m.table.widening)
    ]
    unknown = [m.load for m in compared if m.table is None]
    if unknown:
        notes.append(
            f"{', '.join(unknown)}: the measurement's error is not known (no error_model.json beside it): no "
            "difference counts as seen."
        )
    notes += _covered(done)
    levels = {m.load: "" if m.verdict is None else m.verdict.level for m in compared}
    summed = total(done, [load for load, level in levels.items() if level == "distrust"])
    whole = verdict_on_loads(verdicts)
    levels[ALL_LOADS] = "" if whole is None else whole.level
    write_tables(target, done, [*summed.areas, summed.nothing], strains, levels)
    write_json(
        target / "comparison.json",
        {
            "total_area_ml": {a.model: a.best_ml for a in summed.areas}, "told_apart": list(summed.told),
            "not_told_apart": summed.not_told_apart, "notes": notes,
            "coverage_ml": {one.load: one.found.coverage() for one in done},
            "verdict": _plain(verdict), "verdict_by_load": {m.load: _plain(m.verdict) for m in compared},
        } | record,
    )  # fmt: skip
    done_how = methods(
        {m.load: m.folder for m in compared},
        {file.name: file.path for of in files.values() for file in of},
        len(done[0].found.points_mm), strains, [t.max_shear for t in thresholds_used], least_ml,
        error_known=any(one.bands for one in done), version=versions()["mrstrain"],
    )  # fmt: skip
    beside = [note for note in notes if note not in doubts]  # these stand in the verdict
    sections = page_sections(told, summed, beside, strange, strains)
    closing = closing_sections(thresholds_used, done_how)
    write_report(target / REPORT, "Models against the measurement", verdict, sections, closing, flat(record))
    tell("compare", "comparing", 1.0)
    return Compared(
        target, tuple(done), summed.areas, summed.told, tuple(notes), verdict, tuple(sections), tuple(closing)
    )


def _plain(verdict: Verdict | None) -> dict[str, object] | None:
    return None if verdict is None else {"level": verdict.level, "reasons": list(verdict.reasons)}


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
