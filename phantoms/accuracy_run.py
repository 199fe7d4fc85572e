"""One run of an accuracy study: a phantom pair is made, registered, and compared with the truth voxel by voxel."""

import json
import re
import zlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np

from dvc import (
    Deformation,
    Image,
    LabelMap,
    Mask,
    Registration,
    RigidMotion,
    Settings,
    StrainField,
    evaluate_on_grid,
    register,
)
from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.atomic_files import whole_file
from dvc.deformation.protocol import Motion
from dvc.errors import RegistrationError
from dvc.images.depth import to_surface_mm
from dvc.images.noise import signal_to_noise
from dvc.images.resample import shows
from dvc.own_files import read_arrays
from dvc.worker import Worker
from phantoms.anatomy import Heel
from phantoms.heel import (
    covering,
    heel_grid,
    labels_of,
    misdrawn,
    motion_named,
    random_foot_motion,
    scan,
    wavelength_of,
)
from phantoms.motions import ShearWave

RIGID = ("bone", "ankle")
_MAKING_S, _ALIGNING_S = 16.0, 5.0  # of a run's `Cost.phantom_seconds`, before the engine begins
_REGISTERED = 0.97  # of the time of a run
_STRIDE = 2  # neighbouring voxels are strongly correlated: one in eight is kept
_LAGS = 8
_FORMAT = 3


@dataclass(frozen=True, slots=True)
class AccuracyCase:
    """One registration of an accuracy study.

    Parameters
    ----------
    preset : str
        "gauss-newton", "gauss-newton-bone", "gauss-newton-borders", an elastix preset, or a parameter file (.txt).
    spacing_mm : (3,)
        Voxel size, mm.
    snr : float
        Fat's signal over the noise's standard deviation.
    motion : str
        "still" (registered as a repeat scan is), "smooth", "sliding", "swelling" (volume changes), "Load1" to "Load4",
        "attached-Load1", "attached-Load3" (strain is largest at bone), or "wave-L" with a wavelength L in mm.
    seed : int
        Of the heel, its images and the rigid motion of the foot.
    labels_off : int
        Voxels by which bones and skin are too large (below zero: too small) in the label map, and the masks made from
        it, that the registration is given (`misdrawn`).
    """

    preset: str
    spacing_mm: tuple[float, float, float]
    snr: float
    motion: str
    seed: int
    labels_off: int = 0

    @property
    def name(self) -> str:
        """Name of the run, used for its file and in tables."""
        spacing = "x".join(f"{s:g}" for s in self.spacing_mm)
        off = f"_labels{self.labels_off:+d}" if self.labels_off else ""
        return f"{Path(self.preset).stem}_{spacing}mm_snr{self.snr:g}_{self.motion}_{self.seed}{off}"

    @property
    def keeps_volume(self) -> bool:
        """Whether the motion is isochoric: error models are fitted to such pairs only, registered as such."""
        return self.motion != "swelling"

    @property
    def kind(self) -> str:
        """Kind of the motion: its name without the load, as NAME of "NAME-Load1", and "loads" of "Load1" itself."""
        return re.sub(r"-?Load\d+$", "", self.motion) or "loads"

    @property
    def wavelength_mm(self) -> float | None:
        """Wavelength of a shear wave, mm; None for another motion."""
        return wavelength_of(self.motion)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSamples:
    """Measured and true strain of a run, at one in eight of the heel's voxels that have a result.

    Attributes
    ----------
    estimated_snr : float
        Signal-to-noise ratio estimated in the unloaded image (`dvc.images.noise`).
    seconds : float
        Time of the registration.
    unknown, folded : int
        Sampled voxels without a result, and with det F <= 0.
    tissue : (n,)
        Label numbers (`TISSUES`) in the label map that the registration was given.
    to_bone_mm, to_border_mm : (n,)
        Distance to the surface of the nearest bone (0 in it) and to that of another tissue in that map, mm.
    true_shear, shear : (n,)
        Maximum shear strain (E_1 - E_3) / 2, true and measured.
    u_error_mm : (n, 3)
        Measured minus true displacement of tissue relative to its bone, LPS mm.
    strain, strain_error : (n, 6)
        Measured Green-Lagrange strain, and measured minus true: xx, xy, xz, yy, yz and zz in LPS axes.
    true_slope, slope : (n,)
        H_dn = d . (grad u) n of a shear wave, true and measured; zero for another motion.
    correlation, lag_mm : (3, lags), (lags,)
        Autocorrelation in soft tissue of the errors of the maximum shear strain, of the components of the strain and of
        those of the displacement, and its distances: multiples of two voxels' longest edge, along the axes that have
        it, mm.
    """

    case: AccuracyCase
    estimated_snr: float
    seconds: float
    unknown: int
    folded: int
    tissue: IntArray
    to_bone_mm: Float32Array
    to_border_mm: Float32Array
    true_shear: Float32Array
    shear: Float32Array
    u_error_mm: Float32Array
    strain: Float32Array
    strain_error: Float32Array
    true_slope: Float32Array
    slope: Float32Array
    correlation: FloatArray
    lag_mm: FloatArray

    def write(self, path: Path, key: str) -> None:
        """Write to a file (npz) atomically; ``key`` is the hash of what the run was made from."""
        numbers, arrays = ({name: getattr(self, name) for name in names} for names in (_NUMBERS, _ARRAYS))
        head = {"format": _FORMAT, "key": key, "case": asdict(self.case)} | numbers
        with whole_file(path) as part, part.open("wb") as file:
            np.savez_compressed(file, head=np.array(json.dumps(head)), **arrays)

    @classmethod
    def read(cls, path: Path, key: Callable[[AccuracyCase], str]) -> Self | None:
        """Read what `write` wrote; None where the file is missing, damaged, or its key is not that of its case."""
        try:
            file = read_arrays(path)
            head = json.loads(str(file["head"]))
            case = AccuracyCase(**head["case"] | {"spacing_mm": tuple(head["case"]["spacing_mm"])})
            if head["format"] != _FORMAT or head["key"] != key(case):
                return None
            kept = {n: head[n] for n in _NUMBERS} | {n: file[n] for n in _ARRAYS}
            return cls(case=case, **kept)
        except (OSError, KeyError, ValueError):
            return None


_NUMBERS = ("estimated_snr", "seconds", "unknown", "folded")
_ARRAYS = tuple(f.name for f in fields(ErrorSamples) if f.name not in ("case", *_NUMBERS))
SAMPLED = _ARRAYS[:-2]  # with a value for each sample: all but the autocorrelation and its lags


def measure_run(
    case: AccuracyCase, worker: Worker, computing: AbstractContextManager[object], progress: Callable[[float], None],
    label: Callable[[Image, Mask], LabelMap] | None = None,
) -> ErrorSamples:  # fmt: skip
    """Make the image pair of a case, register it and compare the result with the truth.

    Parameters
    ----------
    worker : Worker
        Process in which elastix runs.
    computing : context manager
        Held while this process itself computes on all cores: a lock, where several cases are measured at once.
    progress : callable
        ``progress(fraction)`` of the run: the pair is made, aligned, registered and compared.
    label : callable, optional
        Makes the label map that the registration is given, numbered as `TISSUES`, from the unloaded image and the mask
        of its bone; its "bone" is the one that is aligned. By default, it is the phantom's own.

    Raises
    ------
    MrstrainError
        If the pair cannot be made or registered.
    """
    # A wave moves the bone too, so there is nothing to align on.
    align_on = "bone" if case.wavelength_mm is None else "none"
    settings = Settings.of(case.preset, align_on=align_on, threads=worker.threads)
    made = _MAKING_S / max(settings.engine.cost.phantom_seconds, 1.4 * (_MAKING_S + _ALIGNING_S))
    aligned = made * (1.0 + _ALIGNING_S / _MAKING_S)

    def told(stage: str, fraction: float) -> None:
        begun, ended = (made, aligned) if stage == "aligning" else (aligned, _REGISTERED)
        progress(begun + (ended - begun) * fraction)

    progress(0.0)
    with computing:
        reference, loaded, labels, motion = _phantom_pair(case)
        body = labels.labels > 0
        if label is not None:
            labels = label(reference, labels.region("bone"))
    if motion is None:
        settings = settings.of_repeat()
    elif case.keeps_volume:
        settings = replace(settings, engine=settings.engine.keeping_volume())
    registration = register(
        reference, loaded, bone=labels.region("bone"), tissue=Mask(labels.grid, labels.labels > 0), labels=labels,
        settings=settings, worker=worker, progress=told,
    )  # fmt: skip
    if (used := registration.settings.engine.name) != settings.engine.name:
        raise RegistrationError(
            f"At this voxel size and noise, the images were registered with {used} instead of {case.preset}. Choose "
            f"smaller voxels or thinner slices, or measure {used} (--preset {used})."
        )
    with computing:
        return sampled_errors(case, labels, body, motion, registration)


def _phantom_pair(case: AccuracyCase) -> tuple[Image, Image, LabelMap, Motion | None]:
    """Both images of a case, the label map that the registration is given, and the true motion (None: no strain)."""
    heel, grid = Heel(case.seed), heel_grid(case.spacing_mm)
    motion = motion_named(heel, case.motion)
    # Each case has noise, bias field and foot motion of its own, the same for all presets.
    number = zlib.crc32(f"{case.motion} {case.spacing_mm} {case.snr}".encode())
    foot = random_foot_motion(case.seed, number) if case.wavelength_mm is None else RigidMotion.identity()
    exact = labels_of(heel, grid)
    reference = scan(heel, grid, snr=case.snr, number=number)
    loaded_grid = covering(grid, foot.apply(exact.region("bone").points()))
    loaded = scan(heel, loaded_grid, motion, foot, snr=case.snr, number=number + 1)
    return reference, loaded, misdrawn(exact, case.labels_off), motion


def sampled_errors(
    case: AccuracyCase, labels: LabelMap, body: BoolArray, truth: Deformation | None, registration: Registration
) -> ErrorSamples:
    """Measured against true displacement and strain, in one of eight labelled voxels of the body (ni, nj, nk).

    ``truth`` is u and grad u of tissue relative to its bone, reference configuration, LPS mm; None where there is no
    strain. Voxels where it is not defined are left out.
    """
    sampled = np.zeros(labels.grid.shape, dtype=bool)
    sampled[::_STRIDE, ::_STRIDE, ::_STRIDE] = True
    sampled &= body & (labels.labels > 0)
    u, H = evaluate_on_grid(registration.displacement, labels.grid, sampled)
    X = labels.grid.points(sampled)
    edge_mm = float(registration.displacement.spacing_mm.min())
    known = np.isfinite(u).all(axis=1) & shows(registration.loaded, registration.alignment.motion.apply(X + u), edge_mm)
    true_u, true_H = (np.zeros_like(u), np.zeros_like(H)) if truth is None else truth.evaluate(X)
    known &= np.isfinite(true_H).all(axis=(1, 2))
    strain, true = StrainField.from_gradient(H), StrainField.from_gradient(true_H)
    d, n = (truth.direction, truth.normal) if isinstance(truth, ShearWave) else (np.zeros(3), np.zeros(3))
    components, u_error = _components(strain), u - true_u
    component_errors = components - _components(true)
    errors = (strain.max_shear - true.max_shear)[:, None], component_errors, u_error
    correlation, lag_mm = _autocorrelation(errors, known, sampled, labels)
    to_bone, to_border = distances_mm(labels)

    def single(values: FloatArray) -> Float32Array:
        return np.asarray(values[known], dtype=np.float32)

    return ErrorSamples(
        case=case, estimated_snr=signal_to_noise(registration.reference, registration.tissue),
        seconds=registration.seconds, unknown=int(np.count_nonzero(~known)),
        folded=int(np.count_nonzero(strain.jacobian[known] <= 0)), tissue=labels.labels[sampled][known],
        to_bone_mm=to_bone[sampled][known], to_border_mm=to_border[sampled][known],
        true_shear=single(true.max_shear), shear=single(strain.max_shear), u_error_mm=single(u_error),
        strain=single(components), strain_error=single(component_errors),
        true_slope=single(np.einsum("i,nij,j->n", d, true_H, n)), slope=single(np.einsum("i,nij,j->n", d, H, n)),
        correlation=correlation, lag_mm=lag_mm,
    )  # fmt: skip


def _components(strain: StrainField) -> FloatArray:
    """The six components of the Green-Lagrange strain: xx, xy, xz, yy, yz, zz, (n, 6)."""
    return np.asarray(strain.green_lagrange[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


def distances_mm(labels: LabelMap) -> tuple[Float32Array, Float32Array]:
    """Distance of every voxel to the nearest bone surface (0 inside) and to the nearest other tissue, mm.

    Bones are the regions "bone" and "ankle"; both arrays have the label map's shape.
    """
    values, spacing = labels.labels, labels.grid.spacing_mm
    to_border = np.full(values.shape, np.inf, dtype=np.float32)
    for number in np.unique(values):
        inside = values == number
        to_border[inside] = to_surface_mm(~inside, spacing)[inside]
    return to_surface_mm(_rigid(labels), spacing), to_border


def _rigid(labels: LabelMap) -> BoolArray:
    return np.isin(labels.labels, [number for number, name in labels.names.items() if name in RIGID])


def _autocorrelation(
    errors: Sequence[FloatArray], known: BoolArray, sampled: BoolArray, labels: LabelMap
) -> tuple[FloatArray, FloatArray]:
    """Autocorrelation in soft tissue of each of the errors (n, components), and its lags in mm.

    It is that along the axes with the longest edge, over all components of an error, (errors, lags).
    """
    spacing, soft = labels.grid.spacing_mm, ~_rigid(labels)[sampled] & known
    axes = [axis for axis in range(3) if spacing[axis] > spacing.max() - 1e-6]
    at, field = sampled.copy(), np.full(labels.labels.shape, np.nan, dtype=np.float32)
    at[sampled] = soft
    found = np.zeros((len(errors), _LAGS))
    for number, error in enumerate(errors):
        remaining = error[soft] - error[soft].mean(axis=0)
        for component in remaining.T:
            field[at] = component
            every = field[::_STRIDE, ::_STRIDE, ::_STRIDE]
            along = [np.moveaxis(every, axis, 0) for axis in axes]
            found[number] += [_mean_product(along, lag) for lag in range(1, _LAGS + 1)]
        found[number] /= np.mean(remaining**2, axis=0).sum()
    return found, _STRIDE * float(spacing.max()) * np.arange(1.0, _LAGS + 1.0)


def _mean_product(fields: list[Float32Array], lag: int) -> float:
    """Mean product of values so far apart along the first axis, over the fields that have any; NaN if none has."""
    products = [field[lag:] * field[:-lag] for field in fields]
    means = [np.nanmean(product) for product in products if np.isfinite(product).any()]
    return float(np.mean(means)) if means else np.nan
