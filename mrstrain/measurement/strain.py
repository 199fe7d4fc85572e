"""`strain`: strain maps from a transform or displacement field that any tool has made."""

from pathlib import Path

import dvc
from dvc import Deformation, read_displacement, read_transform
from dvc.errors import InputError
from mrstrain.measurement.answer import measured_strain
from mrstrain.measurement.case import Case, Series
from mrstrain.options.door import door
from mrstrain.options.measurement import ExistingFiles, Frame, MeshAndAxes
from mrstrain.records.inputs import alone, case_names, output_folder, read_subject, refuse_touching_inputs
from mrstrain.records.provenance import provenance

_TRANSFORMS = (".txt", ".h5", ".hdf5", ".tfm", ".mat", ".xfm", ".npz")


def read_any(deformation: Path | str, frame: str | None = None) -> Deformation:
    """A deformation from the file of any tool: a transform, or a displacement image, which may not tell its frame."""
    source = Path(deformation)
    if source.suffix.lower() in _TRANSFORMS:
        if frame is not None:
            raise InputError(f"{source}: transform files are always in LPS; frame is only for displacement images.")
        return read_transform(source)
    return read_displacement(source, frame=frame)


@door
def strain(
    load0: Path | str, deformation: Path | str, *, out: Path | str, subject_files: ExistingFiles,
    frame: Frame | None = None, onto: MeshAndAxes,
) -> Series:  # fmt: skip
    """Strain maps of a deformation that another tool measured.

    Parameters
    ----------
    load0 : path
        Unloaded image (reference configuration): gives the voxels.
    deformation : path
        An elastix transform file (.txt, with its chain), an ITK transform (.h5, .tfm, .mat), a spline with tissue
        interfaces (.npz), or a displacement image. All map points of the reference to points of the loaded image.
    subject_files
        With a bone, its rigid motion (least squares over its voxels) is removed from the displacement. Strain is
        computed in ``tissue``.
    frame : {"LPS", "RAS"}, optional
        Frame of the components of a displacement image, if no JSON file next to it gives the frame.
    onto
        As in `register`.

    Raises
    ------
    InputError, OutputError
        Before anything is written: if a file cannot be read or does not fit, or ``out`` would replace an input.
    """
    target, source = Path(out), Path(deformation)
    subject = read_subject(load0, subject_files, onto)
    parameters = {
        "frame": frame, "bone_label": subject_files.bone_label, "plate_normal_lps": subject.plate_normal.tolist(),
        "shear_direction_lps": onto.plain()["shear_direction"], **onto.model_dump(include={"mesh_unit", "mesh_frame"}),
    }  # fmt: skip
    total = read_any(source, frame)
    record = provenance("strain", {**subject.files, "deformation": source}, parameters)
    name = case_names([source])[0].removesuffix(source.suffix) or "strain"
    refuse_touching_inputs(target, [name], [source, *subject.files.values()])
    measured = dvc.Measurement.from_deformation(total, subject, name=name)
    with output_folder(target), alone(target):
        case = Case.of(measured, target / name, record)
        first = measured_strain([case.section], subject, {name: case.folder}, target)
        return Series.of(target, (case,), {}, record, first)
