"""From a pair of images to a measurement."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext

from dvc.arguments import checked
from dvc.arrays import FloatArray
from dvc.deformation.protocol import Deformation
from dvc.errors import GeometryError
from dvc.images.image import Image, LabelMap, Mask
from dvc.io.meshes.read import MeshFile
from dvc.measurement.judgement import Evidence
from dvc.measurement.measurement import Measurement
from dvc.measurement.subject import Subject, plate_directions
from dvc.registration.engines import default_engine
from dvc.registration.register import Settings, register
from dvc.trust.error_model import ErrorModel
from dvc.worker import Worker


@checked
def measure(
    reference: Image,
    loaded: Image,
    *,
    bone: Mask | None = None,
    tissue: Mask | None = None,
    labels: LabelMap | None = None,
    settings: Settings | None = None,
    start: Deformation | None = None,
    repeat: Image | None = None,
    landmarks: tuple[FloatArray, FloatArray] | tuple[FloatArray, FloatArray, tuple[str, ...]] | None = None,
    error_model: ErrorModel | None = None,
    mesh: MeshFile | None = None,
    plate_normal: Sequence[float] | None = None,
    shear_direction: Sequence[float] | None = None,
    name: str = "load",
    worker: Worker | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Measurement:
    """Measure the strain of a loaded image against the unloaded one, with its verdict and error bars.

    Arrays in, arrays out: no file is read or written (`Measurement.write` does).

    Parameters
    ----------
    reference, loaded : Image
        Unloaded and loaded image, each in the frame of its own file (LPS mm).
    bone : Mask, optional
        The bone whose motion is removed, on the reference grid; needed if ``settings.align_on`` is "bone", the default.
    tissue : Mask, optional
        Body on the reference grid, bone included; by default found by an intensity threshold.
    labels : LabelMap, optional
        Tissues on the reference grid: statistics by region, and strain discontinuities at tissue interfaces.
    start : Deformation, optional
        First guess of the displacement of tissue relative to its bone, such as that of another load.
    settings : Settings, optional
        Default: the Gauss-Newton engine, with strain discontinuities at tissue interfaces if labels are given, else at
        the surface of the bone; one thread.
    repeat : Image, optional
        A second unloaded image: its apparent strain is the noise floor.
    landmarks : ((n, 3), (n, 3)), optional
        The same points in the unloaded and in the loaded image, LPS mm; also the result of `read_landmarks`.
    error_model : ErrorModel, optional
        By default the one that comes with the engine or preset.
    mesh : MeshFile, optional
        Mesh at whose nodes and cells displacement and strain are written.
    plate_normal, shear_direction : (3,), optional
        LPS. Figures cut through the point of the bone nearest to the plate (default: inferior). With a shear direction,
        strain is also written in the axes of the plate.
    name : str
        Name of the load.
    worker : Worker, optional
        Process to compute in; a new one by default.
    progress : callable, optional
        ``progress(stage, fraction)``.

    Returns
    -------
    Measurement
        ``maps``: displacement (mm), Green-Lagrange strain and det F at the voxels of the unloaded image, reference
        configuration, LPS, NaN where not defined; ``max_shear`` and its ``sigma``; ``verdict``, ``regions`` and more.

    Raises
    ------
    GeometryError, InputError, ParameterError, RegistrationError, WorkerError
        As `dvc.register`, and if the labels are on another grid.
    """
    if labels is not None and not labels.grid.same_as(reference.grid):
        raise GeometryError("The labels are on another grid than the unloaded image; resample them with `fit_mask`.")
    normal, axes = plate_directions(plate_normal, shear_direction)
    pressed = plate_normal is not None or axes is not None
    subject = Subject(reference, bone, tissue, labels, mesh, normal, axes, pressed=pressed)
    chosen = settings or Settings(default_engine(labelled=labels is not None, on_bone=True))
    body, floor = subject.body(), None
    with nullcontext(worker) if worker is not None else Worker(chosen.threads) as runner:
        given = {"bone": bone, "tissue": body, "labels": labels, "worker": runner, "progress": progress}
        if repeat is not None:
            again = register(reference, repeat, settings=chosen.of_repeat(), **given)  # type: ignore[arg-type]
            floor = Measurement.from_registration(again, subject, is_repeat=True).quality.noise_floor
        found = register(reference, loaded, settings=chosen, start=start, **given)  # type: ignore[arg-type]
    evidence = Evidence(landmarks and landmarks[:2], floor, error_model)
    return Measurement.from_registration(found, subject, evidence, name=name)
