"""`level`: models sent through the measurement itself, so that like is compared with like."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from dvc.atomic_files import whole_file, write_whole
from dvc.errors import InputError, RegistrationError, WorkerError
from dvc.images.tissue import tissue_mask
from dvc.io.images.write import write_image
from mrstrain.comparison.model_files import IN_IMAGE, SETTINGS, Reading, loads_of, model_files
from mrstrain.measurement.engines import engine_of, volume_kept
from mrstrain.measurement.measured_folder import measurements_in
from mrstrain.measurement.register import register
from mrstrain.options.comparison import ModelReading
from mrstrain.options.door import door
from mrstrain.options.measurement import (
    EngineOptions,
    MeshAndAxes,
    RegistrationOptions,
    Running,
    Scans,
    Seeded,
    SubjectFiles,
)
from mrstrain.records.inputs import make_output, read_subject, refuse_touching_inputs
from mrstrain.records.provenance import provenance, write_json
from phantoms.twin import loaded_twin
from validate.extrapolation import LEVELLED, carried_on
from validate.fe_result import FeResult
from validate.mapping import filled_from_nearest

_APART_MM, _FEW = 0.1, 0.01


@dataclass(frozen=True, slots=True)
class Levelled:
    """What `level` gave."""

    folder: Path
    lines: tuple[str, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        return [*self.lines, f"Levelled model, for compare: {self.folder}"]


@door
def level(
    load0: Path | str,
    model: Path | str,
    *,
    out: Path | str,
    subject_files: SubjectFiles,
    loads: Sequence[str] = (),
    engine: EngineOptions,
    reading: ModelReading,
    seeded: Seeded,
    progress: Callable[[str, str, float], None] | None = None,
) -> Levelled:
    """Send a model's deformations through the measurement.

    Parameters
    ----------
    load0 : path
        The unloaded image.
    model : path
        A folder with a file for each load, as in `compare`.
    out : path
        Gets a folder called as the model and "-levelled", which `compare` takes beside the model itself, and one ending
        in "-work" with the images that the model would have given and, by load, their registration.
    subject_files
        As in `register`; the bone is needed.
    loads : sequence of str
        Names of the loads; all of the model's files by default.
    engine
        That of the measurement, as in `register`; elastix parameters that are not known are let pass.
    reading
        As in `compare`.
    seeded
        Threads of each registration; the seed is also that of the noise that is drawn anew.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If image, bone or model cannot be used, or the model folds; before anything is registered.
    RegistrationError
        If no load could be registered.
    """
    target, place = Path(out), Path(model)
    # Refused now rather than after the images are made.
    # Beyond its mesh a model is carried on without regard to volume: what the images then ask for is no tissue's.
    volume = volume_kept(engine)
    how = RegistrationOptions(**dict(engine), volume=volume, allow_unknown_parameters=True)
    engine_of(how, labelled=subject_files.labels is not None)
    if not place.is_dir():
        raise InputError(f"{place} is no folder with a model's results, a file for each load.")
    subject = read_subject(load0, subject_files)
    if subject.bone is None:
        raise InputError("Levelling needs the bone (--bone, or --labels and --bone-label): there the model is at rest.")
    wanted = list(loads) or loads_of(place, reading.model_mesh is not None)
    usual = Reading(reading.model_mesh, reading.model_unit, reading.model_frame)
    files, notes = model_files(wanted, [place], usual)
    name = place.resolve().name + LEVELLED
    work = name + "-work"
    given = [p for of in (subject_files, engine, reading) for p in of.paths]
    refuse_touching_inputs(target, [name, work], [Path(load0), *given, *(f.path for of in files.values() for f in of)])
    results: dict[str, FeResult] = {}
    body = subject.tissue or tissue_mask(subject.reference)
    made = {}
    for load, (file,) in files.items():
        results[load] = file.read(subject.reference.grid)
    for load, result in results.items():
        field = carried_on(result.deformation, subject.reference.grid, subject.bone.inside)
        middles = result.mesh.centroids_mm
        apart = field.displacement(middles) - result.deformation.displacement(middles)
        share = float(np.mean(np.linalg.norm(apart, axis=1) > _APART_MM))
        if share > _FEW:
            notes.append(
                f"{load}: where the model's cells are nearly flat it was smoothed before it moved the image, by over "
                f"{_APART_MM:g} mm in {share:.0%} of its cells."
            )
        made[load] = loaded_twin(subject.reference, body, field, seed=seeded.seed)
    for folder in (target, target / name, target / work, target / work / "images"):
        make_output(folder)
    for load in results:  # of an earlier run
        (target / name / f"{load}.vtu").unlink(missing_ok=True)
    record = provenance(
        "level",
        {
            **subject.files,
            "models": [f.path for of in files.values() for f in of],
            "parameters": list(engine.parameters),
        },
        {
            **engine.model_dump(exclude={"parameters"}),
            "volume": volume,
            **seeded.plain(),
            "bone_label": subject_files.bone_label,
            **reading.model_dump(exclude={"model_mesh"}),
        },
    )
    write_json(target / name / "provenance.json", record)
    for load, twin in made.items():
        write_image(target / work / "images" / f"{load}.nii.gz", twin.image)
    write_whole(target / name / SETTINGS, IN_IMAGE)
    failures, registered = list[str](), target / work / "registered"
    make_output(registered)
    for load, result in results.items():  # each in a folder of its own: a study levels several at once
        try:
            register.with_options(
                load0, [target / work / "images" / f"{load}.nii.gz"], out=registered / load,
                subject_files=subject_files, registration=how, scans=Scans(), onto=MeshAndAxes(),
                running=Running(**dict(seeded)), progress=progress,
            )  # fmt: skip
        except (RegistrationError, WorkerError) as failed:
            failures.append(f"{load} was not registered: {failed}")
        else:
            _write(target / name / f"{load}.vtu", result, registered / load)
    if len(failures) == len(results):
        raise RegistrationError(" ".join(failures))
    notes += failures
    return Levelled(target / name, tuple(notes))


def _write(path: Path, result: FeResult, registered: Path) -> None:
    """The measured displacement at the nodes of the model's mesh; where it is not defined, that of the nearest node."""
    mesh = result.mesh
    (measured,) = measurements_in(registered)
    u = filled_from_nearest(measured.deformation().displacement(mesh.points_mm), mesh.points_mm)
    region = np.zeros(len(mesh.cells), dtype=np.int64)
    for number, cells in enumerate(mesh.regions.values(), start=1):
        region[cells] = number
    written = meshio.Mesh(mesh.points_mm, [("tetra", mesh.cells)], {"displacement_mm": u}, {"region": [region]})
    with whole_file(path) as part:
        meshio.vtu.write(part, written, binary=True)
    names = {str(number): name for number, name in enumerate(mesh.regions, start=1)}
    write_whole(path.with_suffix(".json"), json.dumps({"regions": names}) + "\n")
