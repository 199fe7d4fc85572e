"""`compare`: comparison of finite-element models of any code with a measurement, from files to a report."""

import pickle
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import validate
from dvc import Deformation, Grid, LabelMap, TetMesh, plate_axes
from dvc.arrays import FloatArray
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import ERROR_MODEL, REGISTERED, REPORT, ResultFolder, result_folders
from dvc.measurement.subject import bones_of
from dvc.report.page import Section
from dvc.threads import usable_cores
from dvc.worker import Each, side_by_side
from fe import read_tet_mesh
from mrstrain.comparison.credibility import Holdings, credibility_section
from mrstrain.comparison.from_record import fill_directions, fill_labels, taken_from_record
from mrstrain.comparison.methods import methods
from mrstrain.comparison.model_files import ModelFile, model_files, with_variants
from mrstrain.models.variant_files import variant_folders
from mrstrain.options.door import door
from mrstrain.options.model import Vector
from mrstrain.options.modelling import ComparisonDirections, ComparisonLabels, ComparisonOn, ModelReading
from mrstrain.records.doctor import usable_memory_bytes
from mrstrain.records.durations import comparison as comparison_of
from mrstrain.records.inputs import alone, output_folder, read_given_labels, refuse_touching_inputs
from mrstrain.records.progress import NOTE, OnProgress, expect
from mrstrain.records.provenance import provenance

_BYTES_OF_A_LOAD = 1 << 30  # approximate memory of the process that compares one load


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Result of `compare`: the comparison, and the sections of its report."""

    out: Path
    comparison: validate.Comparison
    sections: tuple[Section, ...]
    closing: tuple[Section, ...]
    taken: tuple[str, ...] = ()  # a line on what was taken from the record of the measurement, unless already told

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        return [*self.taken, *self.comparison.summary(), f"Report: {self.out / REPORT}"]


@door
def compare(
    dvc: Path | str, models: Sequence[Path | str], *, out: Path | str, labelling: ComparisonLabels,
    loads: Sequence[str] = (), reading: ModelReading, to_image: FloatArray | None = None,
    directions: ComparisonDirections, towards: Mapping[str, tuple[Vector, Vector]] | None = None,
    comparison: ComparisonOn, variants: Sequence[Path | str] = (), remarks: Sequence[str] = (),
    progress: OnProgress | None = None,
) -> Compared:  # fmt: skip
    """Compare finite-element models of any code with a measurement; see `validate.compare`.

    Label map, names, bone and the plate's directions are those of the measurement's record unless they are given.

    Parameters
    ----------
    dvc : path
        Results of `register` or `strain`: the folder with one folder per load, or the folder of one load.
    models : sequence of path
        Folders with a file named after each load (Load1.vtu ...; .csv with ``model_mesh``), or the file of a single
        load.
    out : path
        Gets ``report.html``, tables, and a folder for each load.
    loads : sequence of str
        Names of measured loads; all by default.
    to_image : (4, 4), optional
        As in `validate.read_result`.
    towards : mapping, optional
        Outward normal of the plate and direction of shear, LPS (3,), of loads with their own directions, by name.
    labelling, reading, directions, comparison
        Their fields are given as keywords, such as ``strains=...``.
    variants : sequence of path
        Folders of variants (results of a model with one input changed, and a ``variant.toml``), or folders of such
        folders. They give the input uncertainty of the models.
    remarks : sequence of str
        Sentences for the notes of the report.
    progress : callable, optional
        ``progress(case, stage, fraction)``; the case "note" first tells what was taken from the record.

    Raises
    ------
    InputError
        If measurement and models have no load in common, or if an input that is not given is not found as it was
        measured with; also as `validate.compare`.
    """
    target, tell, measurements = Path(out), progress or (lambda *_: None), result_folders(Path(dvc), loads)
    labelling, labels_given = fill_labels(labelling, measurements), labelling
    assert labelling.labels is not None
    usual, of_load = fill_directions(directions, measurements)
    more = [f"(and the plate's directions of {', '.join(of_load)})"] if of_load else []
    taken = taken_from_record(Path(dvc), (labels_given, labelling), (directions, usual), more=more)
    for line in taken:  # now, so that a wrong file is noticed before an hour is spent on it
        tell(NOTE, line, 0.0)
    tissues = read_given_labels(labelling.labels, labelling.names)
    bones = bones_of(tissues, labelling.bones)
    if not bones:
        names, name = ", ".join(tissues.names.values()), "Name a bone among them (--bone)."
        tell(NOTE, f"No label is named like a bone: {names} are compared as soft tissue. {name}", 0.0)
    thresholds = validate.read_thresholds(comparison.thresholds)
    criteria = validate.Criteria(comparison.strains, thresholds, comparison.least_ml)
    pairs = {load: (of.plate_normal, of.shear_direction) for load, of in of_load.items()} | dict(towards or {})
    axes, own = _axes(usual.plate_normal, usual.shear_direction), {load: _axes(*of) for load, of in pairs.items()}
    files, notes = model_files([m.load for m in measurements], [Path(m) for m in models], reading, to_image)
    varied = variant_folders(Path(place) for place in variants)
    files, of_variants = with_variants(files, varied, reading, to_image)
    notes = [*remarks, *notes, *of_variants]
    results = [file for of in files.values() for file in of]
    inputs = {
        "measured": [f for m in measurements for f in m.files],
        "models": [*(file.path for file in results), *dict.fromkeys(p for file in results for p in file.reading.paths)],
        **({"variants": list(dict.fromkeys(p for file in results for p in file.variant_paths))} if varied else {}),
        **labelling.files,
        "mesh": [] if comparison.mesh is None else [comparison.mesh],
        "error_models": [f for m in measurements if (f := m.folder / ERROR_MODEL).is_file()],
    }
    refuse_touching_inputs(target, list(files), [path for paths in inputs.values() for path in paths])
    if target.resolve() in [f.resolve() for f in (Path(dvc), *(m.folder for m in measurements), *map(Path, models))]:
        raise InputError(
            f"{target} contains results to be compared and would be overwritten. Choose another out folder."
        )
    common = None if comparison.mesh is None else _common_mesh(comparison.mesh, tissues, bones)
    compared = {m.load: m for m in measurements if m.load in files}
    given = {
        "bones": list(bones), "plate_axes_lps": axes.tolist(), "strains": list(criteria.strains),
        "plate_axes_lps_of": {load: of.tolist() for load, of in own.items()}, "least_cluster_ml": criteria.least_ml,
        "thresholds": [[t.max_shear, t.source] for t in thresholds], **reading.model_dump(exclude={"model_mesh"}),
        "to_image": None if to_image is None else np.asarray(to_image).tolist(), "seed": criteria.seed,
        "files": {load: {file.name: file.path.name for file in of} for load, of in files.items()},
    }  # fmt: skip
    folders, of_models = {load: m.folder for load, m in compared.items()}, {file.name: file.path for file in results}
    at_once = _at_once(len(compared))
    expect(progress, {"compare": comparison_of([len(of) for of in files.values()], at_once)})
    with (
        tempfile.TemporaryDirectory(prefix="mrstrain-") as kept,
        side_by_side("comparing", at_once) as each,
    ):
        cases = [
            _case(m, files[load], tissues.grid, own.get(load, axes), Path(kept) / f"models-{number}")
            for number, (load, m) in enumerate(compared.items())
        ]
        reading_each, comparing_each, writing_each = (
            partial(_told, each, partial(tell, "compare", what)) for what in ("reading", "comparing", "writing")
        )
        # Every file is read before anything is removed; what was read is kept on the disk, as it would fill memory.
        warnings = validate.check_models(cases, tissues, bones, each=reading_each)
        with output_folder(target), alone(target):
            record = provenance("compare", inputs, given)
            result = validate.compare(
                cases, tissues, bones, mesh=common, criteria=criteria, notes=notes, warnings=warnings,
                each=comparing_each,
            )  # fmt: skip
            said = methods(folders, of_models, result, criteria)
            held = [credibility_section(Holdings.of(result, {name: path.parent for name, path in of_models.items()}))]
            parts = result.write(
                target, record=record, methods=said, more=held, on_image=comparison.on_image, each=writing_each,
                largest=_largest(folders.values()),
            )  # fmt: skip
    return Compared(target, result, *parts, taken if progress is None else ())


def _told(each: Each, tell: Callable[[float], None], task: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    """The results of ``each``, and the fraction that is done."""
    those = list(items)
    tell(0.0)
    for done, result in enumerate(each(task, those), start=1):
        tell(done / len(those))
        yield result


def _largest(folders: Iterable[Path]) -> float | None:
    """Where the colours of the measured strain end in its report; None if a map is missing."""
    from dvc.measurement.side_by_side import shared_scale  # it draws, and matplotlib takes half a second

    try:
        return shared_scale(folders)
    except MrstrainError:
        return None


def _at_once(loads: int) -> int:
    """Number of loads that are compared at the same time with the available cores and memory."""
    memory = usable_memory_bytes()
    fit = loads if memory is None else memory // _BYTES_OF_A_LOAD - 1  # this process takes as much as one of them
    return max(1, min(loads, usable_cores(), fit))


def _axes(normal: Sequence[float], shear: Sequence[float]) -> FloatArray:
    """Axes of the plate (3, 3) from its outward normal and the direction of shear, LPS."""
    return plate_axes(-np.asarray(normal, dtype=np.float64), shear)


def _common_mesh(path: Path, labels: LabelMap, bones: Sequence[str]) -> TetMesh:
    """The mesh on which all fields are compared; it must lie in the labelled soft tissue."""
    mesh = read_tet_mesh(path)
    validate.check_overlap(path, mesh, labels.grid)
    validate.check_in_tissue(path, mesh, labels, bones)
    return mesh


def _case(
    measurement: ResultFolder, files: Sequence[ModelFile], grid: Grid, axes: FloatArray, kept: Path
) -> validate.LoadCase:
    image, known = measurement.folder / REGISTERED, (measurement.table, measurement.verdict, measurement.aligned_on)
    read = partial(_read, measurement, files, grid, kept)
    shown = image if image.is_file() else None
    return validate.LoadCase(measurement.load, read, axes, *known, shown, measurement.without_intervals)


def _read(
    measurement: ResultFolder, files: Sequence[ModelFile], grid: Grid, kept: Path
) -> tuple[Deformation, list[validate.FeResult]]:
    """The measured deformation, and the results in the files of models; ``kept`` holds these once they were read."""
    if kept.exists():
        with kept.open("rb") as file:
            return measurement.deformation(), pickle.load(file)
    results, part = [file.read(grid) for file in files], kept.with_name(f"{kept.name}.part")
    with suppress(OSError):  # a disk without room: they are read again
        with part.open("wb") as written:
            pickle.dump(results, written, protocol=pickle.HIGHEST_PROTOCOL)
        part.replace(kept)
    return measurement.deformation(), results
