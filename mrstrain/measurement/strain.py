"""`strain`: strain maps from a transform or displacement field that any tool has made."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dvc import Deformation, Measurement, Subject, read_displacement, read_transform
from dvc.atomic_files import write_json
from dvc.errors import InputError
from dvc.io.result_folder import PROVENANCE, REPORT
from mrstrain.measurement.case import Case
from mrstrain.measurement.page import write_series_report
from mrstrain.options.door import door
from mrstrain.options.measurement import Frame, MeshAndAxes, SubjectFiles
from mrstrain.records.inputs import case_names, make_output, read_subject, refuse_touching_inputs
from mrstrain.records.provenance import provenance

_TRANSFORMS = (".txt", ".h5", ".hdf5", ".tfm", ".mat", ".xfm", ".npz")


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """A deformation from another tool, which maps points of the subject's reference to the loaded image, LPS mm."""

    subject: Subject
    whole: Deformation
    source: Path
    record: dict[str, object]

    @property
    def files(self) -> list[Path]:
        """All files that were read."""
        return [self.source, *self.subject.files.values()]

    def measured(self, name: str) -> Measurement:
        """Its strain; relative to the bone, where there is one."""
        return Measurement.from_deformation(self.whole, self.subject, name=name)


def read_any(deformation: Path | str, frame: str | None = None) -> Deformation:
    """A deformation from the file of any tool: a transform, or a displacement image, which may not tell its frame."""
    source = Path(deformation)
    if source.suffix.lower() in _TRANSFORMS:
        if frame is not None:
            raise InputError(f"{source}: a transform file is in LPS; a frame is told of displacement images alone.")
        return read_transform(source)
    return read_displacement(source, frame=frame)


def read_deformation(
    subject: Subject, deformation: Path | str, *, frame: str | None, command: str, parameters: Mapping[str, object]
) -> Given:
    """Read a deformation of a subject's unloaded image from the file of any tool."""
    source, whole = Path(deformation), read_any(deformation, frame)
    record = provenance(command, {**subject.files, "deformation": source}, {"frame": frame, **parameters})
    return Given(subject, whole, source, record)


@dataclass(frozen=True, slots=True)
class Strained:
    """Result of `strain`: the folder and the case in it."""

    out: Path
    case: Case

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        return [*self.case.summary(), f"Report: {self.out / REPORT}"]


@door
def strain(
    reference: Path | str,
    deformation: Path | str,
    *,
    out: Path | str,
    subject_files: SubjectFiles,
    frame: Frame | None = None,
    onto: MeshAndAxes,
) -> Strained:
    """Strain maps of a deformation that another tool measured.

    Parameters
    ----------
    reference : path
        Unloaded image (reference configuration): gives the voxels.
    deformation : path
        An elastix transform file (.txt, with its chain), an ITK transform (.h5, .tfm, .mat), a spline with tissue
        interfaces (.npz), or a displacement image. All map points of the reference to points of the loaded image.
    subject_files
        With a bone, its rigid motion (least squares over its voxels) is taken out of the displacement; ``tissue`` is
        where strain is wanted.
    frame : {"LPS", "RAS"}, optional
        Frame of a displacement image's components, where no JSON file beside it tells.
    onto
        As in `register`.
    """
    target, source = Path(out), Path(deformation)
    subject = read_subject(reference, subject_files, onto)
    parameters = {
        "bone_label": subject_files.bone_label,
        "plate_normal_lps": subject.plate_normal.tolist(),
        "shear_direction_lps": onto.plain()["shear_direction"],
        "mesh_unit": onto.mesh_unit,
        "mesh_frame": onto.mesh_frame,
    }
    given = read_deformation(subject, deformation, frame=frame, command="strain", parameters=parameters)
    name = case_names([source])[0].removesuffix(source.suffix) or "strain"
    refuse_touching_inputs(target, [name], given.files)
    measured = given.measured(name)
    make_output(target)
    case = Case.of(measured, target / name, given.record)
    write_json(target / PROVENANCE, given.record)
    write_series_report(target / REPORT, [case.section], {}, given.record)
    return Strained(target, case)
