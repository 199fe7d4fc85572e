"""`level`: models sent through the measurement itself, so that like is compared with like."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from dvc.atomic_files import whole_file, write_json, write_whole
from dvc.errors import InputError, RegistrationError, WorkerError
from dvc.images.tissue import tissue_mask
from dvc.io.images.write import write_image
from dvc.io.result_folder import PROVENANCE, result_folders
from dvc.registration.gauss_newton.fit import USUAL_VOLUME
from dvc.registration.register import GAUSS_NEWTON
from mrstrain.comparison.model_files import IN_IMAGE, SETTINGS, Reading, loads_of, model_files
from mrstrain.measurement.engines import engine_of, settings_of
from mrstrain.measurement.register import register
from mrstrain.records.inputs import make_output, read_subject, refuse_touching_inputs
from mrstrain.records.provenance import provenance
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


def level(
    load0: Path | str,
    model: Path | str,
    *,
    out: Path | str,
    bone: Path | str | None = None,
    bone_label: str | None = None,
    tissue: Path | str | None = None,
    labels: Path | str | None = None,
    names: Path | str | None = None,
    loads: Sequence[str] = (),
    engine: str | None = None,
    borders: bool | None = None,
    preset: str | None = None,
    parameters: Sequence[Path | str] = (),
    model_mesh: Path | str | None = None,
    model_unit: str = "mm",
    model_frame: str = "LPS",
    threads: int | None = None,
    seed: int = 1,
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
    bone, bone_label, tissue, labels, names
        As in `register`; the bone is needed.
    loads : sequence of str
        Names of the loads; all of the model's files by default.
    engine, borders, preset, parameters
        Those of the measurement, as in `register`; elastix parameters that are not known are let pass.
    model_mesh, model_unit, model_frame
        As in `compare`.
    threads : int, optional
        Of each registration; by default all cores.
    seed : int
        Of the noise that is drawn anew, and of the registration.
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
    volume = USUAL_VOLUME if engine_of(engine, preset, parameters) == GAUSS_NEWTON else None
    settings_of(
        engine, preset, parameters, volume=volume, borders=borders, labelled=labels is not None, allow_unknown=True
    )
    if not place.is_dir():
        raise InputError(f"{place} is no folder with a model's results, a file for each load.")
    subject = read_subject(load0, bone=bone, bone_label=bone_label, tissue=tissue, labels=labels, names=names)
    if subject.bone is None:
        raise InputError("Levelling needs the bone (--bone, or --labels and --bone-label): there the model is at rest.")
    wanted = list(loads) or loads_of(place, model_mesh is not None)
    usual = Reading(None if model_mesh is None else Path(model_mesh), model_unit, model_frame)
    files, notes = model_files(wanted, [place], usual)
    name = place.resolve().name + LEVELLED
    work = name + "-work"
    given = [Path(p) for p in (load0, bone, tissue, labels, names, model_mesh, *parameters) if p is not None]
    refuse_touching_inputs(target, [name, work], [*given, *(f.path for of in files.values() for f in of)])
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
        made[load] = loaded_twin(subject.reference, body, field, seed=seed)
    for folder in (target, target / name, target / work, target / work / "images"):
        make_output(folder)
    for load in results:  # of an earlier run
        (target / name / f"{load}.vtu").unlink(missing_ok=True)
    record = provenance(
        "level",
        {
            **subject.files,
            "models": [f.path for of in files.values() for f in of],
            "parameters": [Path(p) for p in parameters],
        },
        {
            "engine": engine,
            "volume": volume,
            "borders": borders,
            "preset": preset,
            "threads": threads,
            "seed": seed,
            "bone_label": bone_label,
            "model_unit": model_unit,
            "model_frame": model_frame,
        },
    )
    write_json(target / name / PROVENANCE, record)
    for load, twin in made.items():
        write_image(target / work / "images" / f"{load}.nii.gz", twin.image)
    write_whole(target / name / SETTINGS, IN_IMAGE)
    failures, registered = list[str](), target / work / "registered"
    make_output(registered)
    for load, result in results.items():  # each in a folder of its own: a study levels several at once
        try:
            register(
                load0, [target / work / "images" / f"{load}.nii.gz"], out=registered / load, bone=bone,
                bone_label=bone_label, tissue=tissue, labels=labels, names=names, engine=engine,
                volume=volume, borders=borders, preset=preset, parameters=parameters, allow_unknown_parameters=True,
                threads=threads, seed=seed, progress=progress,
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
    (measured,) = result_folders(registered)
    u = filled_from_nearest(measured.deformation().displacement(mesh.points_mm), mesh.points_mm)
    region = np.zeros(len(mesh.cells), dtype=np.int64)
    for number, cells in enumerate(mesh.regions.values(), start=1):
        region[cells] = number
    written = meshio.Mesh(mesh.points_mm, [("tetra", mesh.cells)], {"displacement_mm": u}, {"region": [region]})
    with whole_file(path) as part:
        meshio.vtu.write(part, written, binary=True)
    names = {str(number): name for number, name in enumerate(mesh.regions, start=1)}
    write_whole(path.with_suffix(".json"), json.dumps({"regions": names}) + "\n")
