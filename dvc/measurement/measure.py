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
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonWithInterfaces
from dvc.registration.register import Settings, register
from dvc.trust.error_model import ErrorModel, error_model_of
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
        The bone whose motion is taken out, on the reference grid; may be missing if ``settings.align_on`` is another.
    tissue : Mask, optional
        Body on the reference grid, bone included; found by a threshold where it is not given.
    labels : LabelMap, optional
        Tissues on the reference grid: statistics by region, and strain discontinuities at their borders.
    start : Deformation, optional
        A first guess of the displacement of tissue relative to its bone, such as another load's.
    settings : Settings, optional
        By default Gauss-Newton, with strain discontinuities at tissue interfaces if there are labels; one thread.
    repeat : Image, optional
        A second unloaded image: its apparent strain is the noise floor.
    landmarks : ((n, 3), (n, 3)), optional
        Points of the unloaded image and the same of the loaded one, LPS mm; also as `read_landmarks` returns them.
    error_model : ErrorModel, optional
        By default the one that comes with the engine or preset.
    mesh : MeshFile, optional
        Displacement and strain are written at its nodes and cells.
    plate_normal, shear_direction : (3,), optional
        LPS. The plate's outward normal (default: inferior) finds the bone's lowest point, where pictures cut; with a
        shear direction, strain is written in the plate's axes as well.
    name : str
        Of the load.
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
        As `dvc.register`, and if the labels lie on another grid.
    """
    if labels is not None and not labels.grid.same_as(reference.grid):
        raise GeometryError("The labels are on another grid than the unloaded image; resample them with `fit_mask`.")
    normal, axes = plate_directions(plate_normal, shear_direction)
    subject = Subject(reference, bone, tissue, labels, mesh, normal, axes)
    chosen = settings or Settings(GaussNewton() if labels is None else GaussNewtonWithInterfaces())
    body, floor = subject.body(), None
    with nullcontext(worker) if worker is not None else Worker(chosen.threads) as runner:
        given = {"bone": bone, "tissue": body, "labels": labels, "worker": runner, "progress": progress}
        if repeat is not None:
            again = register(reference, repeat, settings=chosen.of_repeat(), **given)  # type: ignore[arg-type]
            floor = Measurement.from_registration(again, subject, is_repeat=True).quality.noise_floor
        found = register(reference, loaded, settings=chosen, start=start, **given)  # type: ignore[arg-type]
    points, model = landmarks and landmarks[:2], error_model or error_model_of(chosen.engine.name)
    return Measurement.from_registration(found, subject, Evidence(points, floor, model), name=name)
