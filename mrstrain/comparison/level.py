"""`level`: forward-model comparison (levelling), the measurement simulated on the displacement of a model."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from dvc import Image, Subject, TetMesh, tissue_mask, write_image
from dvc.atomic_files import write_json, write_whole
from dvc.errors import InputError, RegistrationError, WorkerError
from dvc.io.images.dicom import is_dicom
from dvc.io.result_folder import PROVENANCE, holds_results, result_folders
from fe import write_tet_mesh
from mrstrain.comparison.from_record import fill_engine, fill_subject, taken_from_record
from mrstrain.comparison.model_files import IN_IMAGE, SETTINGS, loads_of, model_files
from mrstrain.measurement.engines import engine_of, volume_kept
from mrstrain.measurement.register import register
from mrstrain.options import measurement as options
from mrstrain.options.door import door
from mrstrain.options.modelling import ModelReading
from mrstrain.records.durations import registrations
from mrstrain.records.inputs import alone, make_output, read_subject, refuse_touching_inputs
from mrstrain.records.measured_with import MeasuredWith
from mrstrain.records.outcome import Outcome
from mrstrain.records.progress import NOTE, OnProgress, expect
from mrstrain.records.provenance import provenance
from phantoms import Acquisition, synthetic_warp
from validate import LEVELLED, FeResult, extrapolated, filled_from_nearest

_log = logging.getLogger(__name__)
_CHANGED_MM, _FEW = 0.1, 0.01


@door
def level(
    dvc: Path | str, model: Path | str, *, out: Path | str, subject_files: options.RecordedFiles,
    loads: Sequence[str] = (), engine: options.RecordedEngine, reading: ModelReading, seeded: options.Seeded,
    progress: OnProgress | None = None,
) -> Outcome:  # fmt: skip
    """Simulate the measurement of a model: its displacement warps the unloaded image, and the pair is registered.

    Parameters
    ----------
    dvc : path
        Results of `register`, or one of its loads: the unloaded image, and what is known of it, and the engine are then
        those of its record unless they are given. Or the unloaded image, with all else given.
    model, reading
        A folder with a file for each load, and how it is read; as in `compare`.
    out : path
        Gets the folder MODEL-levelled, for `compare` in addition to the model itself, and MODEL-levelled-work with
        the warped images and their registrations.
    subject_files, engine
        As in the registration of the measurement. A bone is needed; unknown elastix parameters are accepted.
    loads, progress
        As in `compare`; by default all loads for which the model has a file.
    seeded
        Threads of each registration, and the seed, which is also that of the fresh noise.

    Raises
    ------
    InputError
        If image, bone or model cannot be used, if an input of the measurement is not found as it was, or if the
        displacement of the model folds; before anything is registered.
    RegistrationError
        If no load could be registered.
    """
    target, place, load0 = Path(out), Path(model), Path(dvc)
    taken: tuple[str, ...] = ()
    if not place.is_dir():
        raise InputError(f"{place} is not a folder with the results of a model (one file for each load).")
    if holds_results(load0):
        load0, subject_files, engine, taken = _from_record(load0, subject_files, engine)
    elif load0.is_dir() and not any(is_dicom(path) for path in load0.iterdir() if path.is_file()):
        raise InputError(
            f"{load0} has neither results of `mrstrain register` nor DICOM images. Give the results first, or the "
            "unloaded image, and then the folder of the model."
        )
    for line in taken:  # now, so that a wrong file is noticed before an hour is spent on it
        (progress or (lambda *_: None))(NOTE, line, 0.0)
    # Incompressibility is always enforced: the displacement extrapolated outside the model's mesh is not isochoric.
    volume = volume_kept(engine)
    how = options.RegistrationOptions(**dict(engine), volume=volume, allow_unknown_parameters=True)
    # refused now rather than after the images are made
    cost = engine_of(how, labelled=subject_files.labels is not None).cost
    subject = read_subject(load0, subject_files)
    of_load, notes = model_files(list(loads) or loads_of(place, reading.model_mesh is not None), [place], reading)
    files = {load: file for load, (file,) in of_load.items()}
    name = place.resolve().name + LEVELLED
    inputs = [load0, *(p for of in (subject_files, engine, reading) for p in of.paths)]
    refuse_touching_inputs(target, [name, f"{name}-work"], [*inputs, *(f.path for f in files.values())])
    results = {load: file.read(subject.reference.grid) for load, file in files.items()}
    images, smoothed = _warped_images(subject, results, seeded.seed)
    sources = {"models": [f.path for f in files.values()], "parameters": list(engine.parameters)}
    about = engine.model_dump(exclude={"parameters"}) | {"volume": volume} | seeded.plain()
    about |= {"bone_label": subject_files.bone_label} | reading.model_dump(exclude={"model_mesh"})
    work, failures = target / f"{name}-work", list[str]()
    make_output(work)
    with ExitStack() as held_loads:  # not the folders, which all loads of a model have in common
        for load in results:
            held_loads.enter_context(alone(target / name / f"{load}.vtu", work / f".{load}.lock"))
        _prepare(target, name, images, provenance("level", {**subject.files, **sources}, about))
        expect(progress, registrations(results, cost, float(np.prod(subject.reference.grid.shape))))
        for load, result in results.items():
            registered = work / "registered" / load  # of its own, since a study runs several loads at the same time
            try:
                register.with_options(
                    load0, [work / "images" / f"{load}.nii.gz"], out=registered, subject_files=subject_files,
                    strokes=options.MarksForAuto(), registration=how, scans=options.Scans(), onto=options.MeshAndAxes(),
                    running=options.Running(**dict(seeded)), progress=progress,
                )  # fmt: skip
            except (RegistrationError, WorkerError) as failed:
                failures.append(f"{load} could not be registered: {failed}")
                _log.info("%s failed", load, exc_info=failed)
            else:
                _write(target / name / f"{load}.vtu", result.mesh, registered)
    if len(failures) == len(results):
        raise RegistrationError("\n".join(failures))
    told = f"Forward-model result, for compare: {target / name}"
    return Outcome(target / name, (*(taken if progress is None else ()), *notes, *smoothed, *failures, told))


def _from_record(
    dvc: Path, files: options.RecordedFiles, engine: options.RecordedEngine
) -> tuple[Path, options.RecordedFiles, options.RecordedEngine, tuple[str, ...]]:
    """The unloaded image of a measurement, its files and engine unless given, and a line on what was taken."""
    instead = "the unloaded image in place of the results, with the options of the measurement"
    record = MeasuredWith.shared(result_folders(dvc), instead)
    load0 = record.file("load0", instead)
    if load0 is None:
        raise InputError(f"{record.path} does not name the unloaded image. Give {instead}.")
    of_subject = fill_subject(files, record)
    of_engine = fill_engine(engine, record, labelled=of_subject.labels is not None)
    taken = taken_from_record(dvc, (files, of_subject), (engine, of_engine), more=[str(load0)])
    return load0, of_subject, of_engine, taken


def _warped_images(subject: Subject, results: Mapping[str, FeResult], seed: int) -> tuple[dict[str, Image], list[str]]:
    """The unloaded image warped by each result, with fresh noise; and notes on results that were smoothed for it."""
    if subject.bone is None:
        raise InputError(
            "A forward-model comparison needs the bone, in which the displacement is zero. Give its mask as bone "
            "(--bone), or a label map and the name of its label as labels and bone_label (--labels, --bone-label)."
        )
    images, notes = {}, []
    body = subject.tissue or tissue_mask(subject.reference)
    for load, result in results.items():
        field = extrapolated(result.deformation, subject.reference.grid, subject.bone.inside)
        centroids = result.mesh.centroids_mm
        difference = field.displacement(centroids) - result.deformation.displacement(centroids)
        changed = float(np.mean(np.linalg.norm(difference, axis=1) > _CHANGED_MM))
        if changed > _FEW:
            notes.append(
                f"{load}: the displacement of the model was smoothed around nearly flat cells before the image was "
                f"warped; it changed by over {_CHANGED_MM:g} mm in {100 * changed:.0f} % of the cells."
            )
        images[load] = synthetic_warp(subject.reference, body, field, Acquisition(seed)).image
    return images, notes


def _prepare(target: Path, name: str, images: Mapping[str, Image], record: Mapping[str, object]) -> None:
    """Make the folders and write the images; results of an earlier run are removed."""
    work = target / f"{name}-work"
    for folder in (target, target / name, work, work / "images", work / "registered"):
        make_output(folder)
    for load, image in images.items():
        (target / name / f"{load}.vtu").unlink(missing_ok=True)
        write_image(work / "images" / f"{load}.nii.gz", image)
    write_json(target / name / PROVENANCE, record)
    write_whole(target / name / SETTINGS, IN_IMAGE)


def _write(path: Path, mesh: TetMesh, registered: Path) -> None:
    """Write the registered displacement at the nodes of a model's mesh; gaps are filled from the nearest node."""
    (measured,) = result_folders(registered)
    u = filled_from_nearest(measured.deformation().displacement(mesh.points_mm), mesh.points_mm)
    write_tet_mesh(path, TetMesh(mesh.points_mm, mesh.cells, mesh.regions), {}, {"displacement_mm": u})
