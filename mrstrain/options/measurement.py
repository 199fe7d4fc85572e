"""Options of measuring: the subject, the registration, and where results are wanted."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator

from mrstrain.options.model import Cli, Count, Flag, NotNegative, Options, Positive, Vector

Frame = Literal["LPS", "RAS"]
Unit = Literal["mm", "m"]


class SubjectFiles(Options):
    """What is known of the unloaded image: its bone, body and tissues."""

    panel: ClassVar[str] = "Inputs"

    bone: Path | None = None
    """Mask of the bone whose motion is taken out, on the unloaded image."""
    bone_label: str | None = None
    """Or: the name of the bone in --labels."""
    tissue: Path | None = None
    """Mask of the body. Default: by a threshold."""
    labels: Path | None = None
    """Label map of the tissues on the unloaded image."""
    names: Path | None = None
    """Names of the labels: ITK-SNAP or Slicer table, or CSV."""


class MeshAndAxes(Options):
    """What results are written on beside the voxels: a mesh, and the plate's axes."""

    panel: ClassVar[str] = "Output"

    mesh: Path | None = None
    """Mesh to put displacement and strain on."""
    mesh_unit: Unit = "mm"
    """Unit of the mesh's coordinates."""
    mesh_frame: Frame = "LPS"
    """Frame of the mesh's coordinates."""
    plate_normal: Vector | None = None
    """The plate's outward normal, away from the foot, LPS. Default: 0 0 -1 (patient inferior)."""
    shear_direction: Vector | None = None
    """Direction of the shear force on the tissue, LPS, such as 0 -1 0 (anterior)."""


def _known_engine(name: str) -> str:
    from dvc.registration.engines import families

    if name not in families():
        raise ValueError(f"there are {' and '.join(families())}")
    return name


class EngineOptions(Options):
    """What finds the non-rigid part of a registration."""

    panel: ClassVar[str] = "Registration"

    engine: Annotated[str, AfterValidator(_known_engine)] | None = None
    """What finds the non-rigid part. Default: gauss-newton; with --preset, elastix."""
    borders: Flag | None = None
    """gauss-newton: strain may be discontinuous at interfaces of --labels. Default: with labels. Not for labels that
    are off by more than a voxel."""
    preset: str | None = None
    """Named parameters of elastix, such as heel-mr."""
    parameters: tuple[Path, ...] = ()
    """elastix parameter file(s) of your own, instead of a preset."""


class RegistrationOptions(EngineOptions):
    """How loaded images are registered to the unloaded one."""

    align: Literal["bone", "image", "none"] = "bone"
    """What to align rigidly first."""
    bending: Positive | None = None
    """gauss-newton: weight of bending, 1/mm. Default: chosen for each pair by cross-validation."""
    volume: NotNegative | None = None
    """gauss-newton: weight of the change of volume, 1/mm3. Default: 300, or as the images ask."""
    chain: Flag = False
    """Start each load from the result of the one before it, in the order given."""
    error_model: Annotated[Path | None, Cli(panel="Advanced")] = None
    """Error model that `mrstrain accuracy` wrote, instead of the preset's own."""
    twin: Annotated[Flag, Cli(panel="Output")] = False
    """Also register each pair's twin, whose strain is known: judges error bars. Twice the time."""
    allow_unknown_parameters: Annotated[Flag, Cli(panel="Advanced")] = False
    """Accept parameter names we do not know."""


class Scans(Options):
    """What is known beside the loaded images."""

    panel: ClassVar[str] = "Inputs"

    repeat: Path | None = None
    """A second unloaded image: gives the noise floor."""
    landmarks: Path | None = None
    """CSV of landmark pairs (x0,y0,z0,x1,y1,z1 in mm LPS); for a single loaded image."""
    start: Annotated[Path | None, Cli(panel="Registration")] = None
    """What another tool found for one load, to be refined: a transform or displacement image."""
    start_frame: Annotated[Frame | None, Cli(panel="Registration")] = None
    """Frame of --start, where its file does not tell it."""
    allow_missing: Flag = False
    """Leave NaN or infinite voxels out instead of refusing the image."""


class Threads(Options):
    """With how many threads is computed."""

    panel: ClassVar[str] = "Advanced"

    threads: Count | None = None
    """Threads of each worker. Default: all cores. elastix repeats its results only on the same number of threads."""


class Cores(Threads):
    """How much is computed at once."""

    workers: Count | None = None
    """Loads at once. Default: as many as cores and loads allow."""


class Seeded(Threads):
    """With how many threads is computed, and from which random numbers."""

    seed: Count = 1
    """Seed of all random numbers."""


class Running(Cores, Seeded):
    """How much is computed at once, and from which random numbers."""
