"""Options of measuring: the subject, the registration, and where results are wanted."""

import difflib
import logging
import shlex
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator

from dvc.errors import InputError
from dvc.threads import most_threads, usable_cores
from mrstrain.options.model import Cli, Count, Flag, NotNegative, Options, Positive, Vector

AUTO = Path("auto")
"""In place of a label map: it is made from the image."""
MADE_LABELS = "labels/tissues.nii.gz"
"""The label map that is made, in the folder of the results."""
IMAGE, LABELS = "{image}", "{labels}"
"""Places of the unloaded image and of the label map in a command that segments."""
Frame = Literal["LPS", "RAS"]
Unit = Literal["mm", "m"]
_log = logging.getLogger("mrstrain.options")


def _bearable(threads: int) -> int:
    if threads > (most := most_threads()):
        raise ValueError(f"must be {most} or less (cores of this machine: {usable_cores()})")
    return threads


ThreadCount = Annotated[Count, AfterValidator(_bearable)]


def is_like_auto(labels: Path) -> bool:
    """Whether a label map is called nearly as `AUTO`, but not quite."""
    return labels != AUTO and bool(difflib.get_close_matches(str(labels).lower(), [str(AUTO)]))


def refuse_misspelt_auto(labels: Path, place: Path) -> None:
    """InputError if a label map, relative to a folder, is not there and is called nearly as `AUTO`."""
    if is_like_auto(labels) and not (place / labels).exists():
        raise InputError(f"{labels}: no such file or folder. Did you mean {AUTO}? Check the spelling.")


def in_parallel(workers: int | None) -> int:
    """How many jobs run in parallel: as many as there are cores, or fewer where so many ``workers`` are asked for."""
    cores = usable_cores()
    if workers is not None and workers > cores:
        told = "workers=%d exceeds the %d cores of this machine: at most %d jobs run in parallel."
        _log.warning(told, workers, cores, cores)
    return min(workers or cores, cores)


def command_parts(command: str) -> list[str]:
    """The words of a command that segments; ValueError if a quotation is not closed, or a file has no place in it."""
    parts = shlex.split(command)
    for place, what in ((IMAGE, "the unloaded image"), (LABELS, "the label map")):
        if not any(place in part for part in parts):
            raise ValueError(f"the command needs {place} where it takes {what}, such as: segment {IMAGE} {LABELS}")
    return parts


class BoneAndBody(Options):
    """Masks on the unloaded image."""

    panel: ClassVar[str] = "Inputs"

    bone: Path | None = None
    """Mask of the bone on the unloaded image."""
    tissue: Path | None = None
    """Tissue mask: the body, bones included. Default: found by an intensity threshold."""


class Marks(Options):
    """A few strokes on the unloaded image."""

    panel: ClassVar[str] = "Inputs"

    marks: Annotated[
        Path | None,
        Cli(
            help="Strokes: a label map with a few voxels painted in one or more tissues, on the page written by "
            "--draw, in ITK-SNAP, 3D Slicer (.seg.nrrd) or any other program. Labels within 8 mm of a stroke that "
            "contradicts them are corrected."
        ),
    ] = None
    """Strokes: a label map with a few voxels painted in a tissue, on the page written by draw_strokes, in ITK-SNAP, 3D
    Slicer (.seg.nrrd) or any other program. Where a stroke contradicts the labels, these are corrected within 8 mm."""
    mark_names: Path | None = None
    """Table of the names of the strokes: ITK-SNAP, Slicer or CSV. Default: 1 bone, 2 fat, 3 muscle, 4 skin, 5 tendon, 6
    other."""


class MarksForAuto(Marks):
    """A few strokes on the unloaded image, from which its label map is made."""

    marks: Path | None = None
    """With --labels auto: strokes in a few tissues, as in `mrstrain label`. With a stroke in the bone, --bone is not
    needed."""


class GivenLabels(Options):
    """A label map: of this image, to be corrected, or of another subject's, to be transferred."""

    panel: ClassVar[str] = "Inputs"

    labels: Path | None = None
    """Label map of this image, to be corrected: with --marks, within 8 mm of the strokes that contradict it; without,
    the boundaries of its bones and skin move by up to 2.5 voxels to where the image shows them. With --from: label map
    of that other image, to be transferred."""
    names: Path | None = None
    """Table of the label names: ITK-SNAP, Slicer or CSV."""
    from_image: Annotated[Path | None, Cli(name="--from")] = None
    """Unloaded image of another subject (same part and side of the body, same contrast), whose label map is --labels.
    The two images are registered; --bone is not needed."""


class SubjectFiles(BoneAndBody):
    """What is known of the unloaded image: its bone, body and tissues."""

    bone: Path | None = None
    """Mask of the bone on the unloaded image; the rigid motion of this bone is removed. With --labels auto, or
    without labels, `register` moves its surface to the dark rim of the bone."""
    bone_label: str | None = None
    """Name of the bone in --labels, instead of --bone."""
    labels: Path | None = None
    """Label map of the tissues on the unloaded image, or auto to make it from the image and --bone or --marks."""
    names: Path | None = None
    """Table of the label names: ITK-SNAP, Slicer or CSV."""

    def refuse_missing(self) -> None:
        """InputError for the first path at which there is nothing, other than labels "auto"."""
        if self.labels == AUTO:
            return self.model_copy(update={"labels": None}).refuse_missing()
        if self.labels is not None and type(self) is SubjectFiles:  # others make none
            refuse_misspelt_auto(self.labels, Path())
        super().refuse_missing()


class ExistingFiles(SubjectFiles):
    """What is known of the unloaded image, where no label map is made."""

    labels: Path | None = None
    """Label map of the tissues on the unloaded image."""


class RecordedFiles(SubjectFiles):
    """What is known of the unloaded image, by default as in the record of a measurement."""

    bone: Path | None = None
    """Mask of the bone on the unloaded image; the displacement is zero in it. Default: that of the measurement."""
    tissue: Path | None = None
    """Tissue mask: the body, bones included. Default: that of the measurement, or found by an intensity threshold."""
    bone_label: str | None = None
    """Name of the bone in --labels, instead of --bone. Default: that of the measurement, unless --labels is given."""
    labels: Path | None = None
    """Label map of the tissues on the unloaded image. Default: that of the measurement."""
    names: Path | None = None
    """Table of the label names: ITK-SNAP, Slicer or CSV. Default: that of the measurement, unless --labels is given."""


class MeshAndAxes(Options):
    """What results are written on beside the voxels: a mesh, and the plate's axes."""

    panel: ClassVar[str] = "Output"

    mesh: Path | None = None
    """Mesh on which displacement and strain are also written."""
    mesh_unit: Unit = "mm"
    """Unit of the mesh coordinates."""
    mesh_frame: Frame = "LPS"
    """Frame of the mesh coordinates."""
    plate_normal: Vector | None = None
    """Direction from the body to the plate, in LPS (x left, y posterior, z superior). Default: 0 0 -1 (inferior)."""
    shear_direction: Vector | None = None
    """Direction of the shear force on the tissue, LPS, such as 0 -1 0 (anterior). If given, strain in the plate's axes
    is also written."""


def _known_engine(name: str) -> str:
    from dvc.registration.engines import families

    if name not in families():
        raise ValueError(f"must be {' or '.join(families())}")
    return name


class EngineOptions(Options):
    """The engine of the non-rigid registration."""

    panel: ClassVar[str] = "Registration"

    engine: Annotated[str, AfterValidator(_known_engine)] | None = None
    """Registration engine: gauss-newton or elastix. Default: gauss-newton; with --preset or --parameters, elastix."""
    borders: Flag | None = None
    """gauss-newton: allow strain discontinuities at the tissue interfaces of --labels, or without labels at the surface
    of the bone, which is moved from that of the mask to where the image shows it. Disable it if label boundaries are
    wrong by more than one voxel: one smooth spline is then fitted. Default: on, where there are labels or a bone to
    align on."""
    preset: str | None = None
    """Built-in elastix parameters: heel-mr."""
    parameters: tuple[Path, ...] = ()
    """Your own elastix parameter file, instead of --preset; each file is one stage."""


class RecordedEngine(EngineOptions):
    """The engine of the non-rigid registration, by default that of the record of a measurement."""

    engine: Annotated[str, AfterValidator(_known_engine)] | None = None
    """Registration engine: gauss-newton or elastix. Default: that of the measurement; with --preset or --parameters,
    elastix."""
    borders: Flag | None = None
    """gauss-newton: allow strain discontinuities at tissue interfaces, or without labels at the bone. Default: as in
    the measurement."""
    preset: str | None = None
    """Built-in elastix parameters: heel-mr. Default: those of the measurement, if it was made with elastix."""
    parameters: tuple[Path, ...] = ()
    """Your own elastix parameter file, instead of --preset; each file is one stage. Default: those of the
    measurement."""


class RegistrationOptions(EngineOptions):
    """How loaded images are registered to the unloaded one."""

    align: Literal["bone", "image", "none"] = "bone"
    """Rigid alignment before the non-rigid registration: on the bone, on the whole image, or none."""
    bending: Positive | None = None
    """gauss-newton: bending weight, 1/mm. Default: chosen for each pair by cross-validation."""
    volume: NotNegative | None = None
    """gauss-newton: weight of the volume-change penalty, 1/mm3. Default: 300, relaxed if the images indicate a
    volume change."""
    chain: Flag = False
    """Start each load from the result of the one before it, in the order given."""
    error_model: Annotated[Path | None, Cli(panel="Advanced")] = None
    """Error model written by `mrstrain accuracy`, instead of the built-in one."""
    twin: Flag = False
    """Check the error bars: for each load, also register a synthetic warp of the unloaded image (twin), whose strain is
    known. Takes more than twice the time."""
    allow_unknown_parameters: Annotated[Flag, Cli(panel="Advanced")] = False
    """Accept elastix parameter names that mrstrain does not know."""


class Scans(Options):
    """Inputs in addition to the loaded images."""

    panel: ClassVar[str] = "Inputs"

    repeat: Path | None = None
    """Second unloaded image, which measures the noise floor."""
    landmarks: Path | None = None
    """Pairs of points, from which the registration error is computed: CSV (x0,y0,z0,x1,y1,z1 in mm LPS). Only with one
    loaded image."""
    start: Annotated[Path | None, Cli(panel="Registration")] = None
    """Result of another registration program to start from and refine: a transform or displacement image. Only with one
    loaded image."""
    start_frame: Annotated[Frame | None, Cli(panel="Registration")] = None
    """Coordinate frame of the displacement components in --start, if the file does not state it."""
    allow_missing: Flag = False
    """Treat NaN and infinite voxels as missing, instead of rejecting the image."""


class Threads(Options):
    """Number of threads."""

    panel: ClassVar[str] = "Advanced"

    threads: ThreadCount | None = None
    """Number of threads. Default: all cores."""


class Cores(Threads):
    """Number of threads, and of loads at the same time."""

    threads: ThreadCount | None = None
    """Threads per worker. Default: the cores, divided among the loads computed in parallel."""
    workers: Count | None = None
    """Number of loads computed in parallel. Default: as many as cores and loads allow."""


class Seeded(Threads):
    """Number of threads, and the seed of random numbers."""

    threads: ThreadCount | None = None
    """Number of threads. Default: all cores. elastix reproduces its results only with the same number of threads."""
    seed: Count = 1
    """Seed of all random numbers."""


class Running(Seeded, Cores):
    """Number of threads, loads at the same time, and the seed of random numbers."""

    threads: ThreadCount | None = None
    """Threads per worker. Default: the cores, divided among the loads computed in parallel. elastix reproduces its
    results only with the same number of threads."""

    def shares(self, loads: int) -> tuple[int, int]:
        """How many of the loads are registered at the same time, and the threads of each."""
        at_once = min(in_parallel(self.workers), loads)
        return at_once, self.threads or max(1, usable_cores() // at_once)
