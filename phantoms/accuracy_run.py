"""One run of the accuracy study: a phantom pair is made, registered, and compared with its truth, voxel by voxel."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.atomic_files import whole_file
from dvc.deformation.protocol import Motion, RigidMotion, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from dvc.images.image import LabelMap, Mask
from dvc.images.noise import signal_to_noise
from dvc.images.resample import shows
from dvc.registration.register import Settings, register
from dvc.trust.error_model import to_surface_mm
from dvc.worker import Worker
from phantoms.anatomy import Heel
from phantoms.heel import (
    LOADS,
    badly_drawn,
    covering,
    drawn_motion,
    heel_grid,
    labels_of,
    pressed,
    scan,
    sliding,
    swelling,
    under_load,
)
from phantoms.motions import ShearWave

RIGID = ("bone", "ankle")
_STRIDE = 2  # neighbouring voxels say nearly the same: one in eight is kept
_LAGS = 8
_WAVE_PEAK = 0.2
_FORMAT = 2


@dataclass(frozen=True, slots=True)
class Case:
    """What one run registers.

    Attributes
    ----------
    preset : str
        Name of a preset of elastix, path of a parameter file (.txt), "gauss-newton" or "gauss-newton-borders".
    spacing_mm : (3,)
        Of the voxels, mm.
    snr : float
        Fat's signal over the noise's standard deviation.
    motion : str
        "still" (registered as a repeat scan is), "smooth", "sliding", "swelling" (volume changes), "Load1" to
        "Load4", or "wave-L" with a wavelength L in mm.
    seed : int
        Of the heel, its images and the foot's motion.
    labels_off : int
        By how many voxels bones and skin are too large in the label map that the registration gets, or too small
        (`phantoms.heel.badly_drawn`).
    """

    preset: str
    spacing_mm: tuple[float, float, float]
    snr: float
    motion: str
    seed: int
    labels_off: int = 0

    @property
    def name(self) -> str:
        """For a file and for people."""
        spacing = "x".join(f"{s:g}" for s in self.spacing_mm)
        off = f"_labels{self.labels_off:+d}" if self.labels_off else ""
        return f"{Path(self.preset).stem}_{spacing}mm_snr{self.snr:g}_{self.motion}_{self.seed}{off}"

    @property
    def keeps_volume(self) -> bool:
        """Whether soft tissue does: error models are of such pairs, registered as such."""
        return self.motion != "swelling"

    @property
    def wavelength_mm(self) -> float | None:
        """Of a wave; None for another motion."""
        return float(self.motion.removeprefix("wave-")) if self.motion.startswith("wave-") else None


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What a run found, at one in eight of the heel's voxels that have a result.

    Attributes
    ----------
    case : Case
    estimated_snr : float
        As `dvc.images.noise` finds it in the unloaded image.
    seconds : float
        Of the registration.
    unknown : int
        Voxels of the heel without a result, of those sampled.
    tissue : (n,)
        Label numbers of `phantoms.anatomy.TISSUES`, in the label map that the registration was given.
    to_bone_mm, to_border_mm : (n,)
        Distance to the surface of the nearest bone (0 in it) and to that of another tissue in that map, mm.
    true_shear, shear : (n,)
        Maximal shear (E_1 - E_3) / 2, true and found.
    u_error_mm : (n, 3)
        Found minus true displacement of tissue relative to its bone, LPS mm.
    mean_abs_strain : (n,)
        Mean of the absolute values of the six components of the Green-Lagrange strain found.
    true_slope, slope : (n,)
        H_dn = d . (grad u) n of a wave, true and found; zero for another motion.
    folded : int
        Sampled voxels with det F <= 0.
    voxel : (n, 3)
        Index on the study's grid.
    correlation : (lags,)
        Autocorrelation of the error of the maximal shear in soft tissue.
    lag_mm : (lags,)
        At these distances, mm: multiples of two voxels' longest edge, along the axes that have it.
    """

    case: Case
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
    mean_abs_strain: Float32Array
    true_slope: Float32Array
    slope: Float32Array
    voxel: IntArray
    correlation: FloatArray
    lag_mm: FloatArray

    def write(self, path: Path, key: str) -> None:
        """Write to a file, whole or not at all; ``key`` says what it was made from."""
        numbers = {n: getattr(self, n) for n in ("estimated_snr", "seconds", "unknown", "folded")}
        head = {"format": _FORMAT, "key": key, "case": asdict(self.case)} | numbers
        arrays = {n: getattr(self, n) for n in _ARRAYS}
        with whole_file(path) as part, part.open("wb") as file:
            np.savez_compressed(file, head=np.array(json.dumps(head)), **arrays)

    @classmethod
    def read(cls, path: Path, key: Callable[[Case], str]) -> Samples | None:
        """Read what `write` wrote; None where the file is missing, damaged, or its key is not that of its case."""
        try:
            with np.load(io.BytesIO(path.read_bytes())) as file:
                head = json.loads(str(file["head"]))
                if head["format"] != _FORMAT:
                    return None
                case = Case(**head["case"] | {"spacing_mm": tuple(head["case"]["spacing_mm"])})
                if head["key"] != key(case):
                    return None
                numbers = {n: head[n] for n in ("estimated_snr", "seconds", "unknown", "folded")}
                return cls(case=case, **numbers, **{n: file[n] for n in _ARRAYS})
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            return None


_ARRAYS = (
    "tissue",
    "to_bone_mm",
    "to_border_mm",
    "true_shear",
    "shear",
    "u_error_mm",
    "mean_abs_strain",
    "true_slope",
    "slope",
    "voxel",
    "correlation",
    "lag_mm",
)


def motion_named(heel: Heel, name: str) -> Motion | None:
    """The motion of a heel's tissue by its name (see `Case`); None for "still".

    Raises
    ------
    InputError
        For a name that is none.
    """
    if name == "still":
        return None
    if name == "smooth":
        return pressed(heel)
    if name == "sliding":
        return sliding(heel, 4.0)
    if name == "swelling":
        return swelling(heel)
    if name in LOADS:
        return under_load(heel, name)
    if name.startswith("wave-"):
        try:
            wavelength = float(name.removeprefix("wave-"))
        except ValueError:
            wavelength = float("nan")
        # Along the foot, with its crests across the pad's thickness; each heel sees another phase.
        phase = float(np.random.default_rng([heel.seed, 4]).uniform(0.0, 2.0 * np.pi))
        return ShearWave(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]), wavelength, _WAVE_PEAK, phase)
    raise InputError(
        f"No motion '{name}'; there are still, smooth, sliding, swelling, {', '.join(LOADS)} and wave-L (L in mm)."
    )


def measure(
    case: Case, worker: Worker, making: AbstractContextManager[object], progress: Callable[[float], None]
) -> Samples:
    """Make the pair of a case, register it and compare with the truth.

    Parameters
    ----------
    case : Case
    worker : Worker
        Process in which elastix runs.
    making : context manager
        Held while this process itself computes, on all cores: a lock, where several cases are measured at once.
    progress : callable
        ``progress(fraction)`` of the registration.

    Raises
    ------
    MrstrainError
        If the case cannot be made or registered.
    """
    with making:
        heel = Heel(case.seed)
        grid = heel_grid(case.spacing_mm)
        motion = motion_named(heel, case.motion)
        wave = case.wavelength_mm is not None
        # Every pair is scanned anew, with noise, shading and foot motion of its own; presets see the same pairs.
        number = zlib.crc32(f"{case.motion} {case.spacing_mm} {case.snr}".encode())
        foot = RigidMotion.identity() if wave else drawn_motion(case.seed, number)
        exact = labels_of(heel, grid)
        labels = badly_drawn(exact, case.labels_off)
        bone, body = labels.region("bone"), Mask(grid, labels.labels > 0)
        reference = scan(heel, grid, snr=case.snr, number=number)
        where = covering(grid, foot.apply(exact.region("bone").points()))
        loaded = scan(heel, where, motion, foot, snr=case.snr, number=number + 1)
    # A wave moves the bone too: nothing there to align on.
    settings = Settings.of(case.preset, align_on="none" if wave else "bone", threads=worker.threads)
    if motion is None:
        settings = settings.of_repeat()
    elif case.keeps_volume:
        settings = replace(settings, engine=settings.engine.keeping_volume())
    found = register(
        reference,
        loaded,
        bone=bone,
        tissue=body,
        labels=labels,
        settings=settings,
        worker=worker,
        progress=lambda stage, fraction: progress(fraction if stage != "aligning" else 0.0),
    )
    with making:
        edge = float(found.displacement.spacing_mm.min())
        kept = np.zeros(grid.shape, dtype=bool)
        kept[::_STRIDE, ::_STRIDE, ::_STRIDE] = True
        kept &= labels.labels > 0
        u, H = evaluate_on_grid(found.displacement, grid, kept)
        X = grid.points(kept)
        known = np.isfinite(u).all(axis=1) & shows(loaded, found.alignment.motion.apply(X + u), edge)
        true_u, true_H = (np.zeros_like(u), np.zeros_like(H)) if motion is None else motion.evaluate(X)
        strain, truth = StrainField.from_gradient(H), StrainField.from_gradient(true_H)
        d, n = (motion.direction, motion.normal) if isinstance(motion, ShearWave) else (np.zeros(3), np.zeros(3))
        error = (strain.max_shear - truth.max_shear).astype(np.float32)
        correlation, lag_mm = _autocorrelation(error, known, kept, labels)
        to_bone, to_border = distances_mm(labels)
        upper = strain.green_lagrange[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]

        def single(values: FloatArray) -> Float32Array:
            return np.asarray(values[known], dtype=np.float32)

        return Samples(
            case=case,
            estimated_snr=signal_to_noise(reference, body),
            seconds=found.seconds,
            unknown=int(np.count_nonzero(~known)),
            folded=int(np.count_nonzero(strain.jacobian[known] <= 0)),
            tissue=labels.labels[kept][known],
            to_bone_mm=to_bone[kept][known],
            to_border_mm=to_border[kept][known],
            true_shear=single(truth.max_shear),
            shear=single(strain.max_shear),
            u_error_mm=single(u - true_u),
            mean_abs_strain=single(np.abs(upper).mean(axis=1)),
            true_slope=single(np.einsum("i,nij,j->n", d, true_H, n)),
            slope=single(np.einsum("i,nij,j->n", d, H, n)),
            voxel=np.argwhere(kept)[known].astype(np.int64),
            correlation=correlation,
            lag_mm=lag_mm,
        )


def distances_mm(labels: LabelMap) -> tuple[Float32Array, Float32Array]:
    """Distance of every voxel to the surface of the nearest bone (0 in it), and to that of another tissue, mm.

    Bones are the regions called "bone" and "ankle".
    """
    values, spacing = labels.labels, labels.grid.spacing_mm
    bone = np.isin(values, [number for number, name in labels.names.items() if name in RIGID])
    to_border = np.full(values.shape, np.inf, dtype=np.float32)
    for number in np.unique(values):
        inside = values == number
        to_border[inside] = to_surface_mm(~inside, spacing)[inside]
    return to_surface_mm(bone, spacing), to_border


def _autocorrelation(
    error: Float32Array, known: BoolArray, kept: BoolArray, labels: LabelMap
) -> tuple[FloatArray, FloatArray]:
    """Of the error in soft tissue, along the axes with the longest edge."""
    coarse = labels.labels[::_STRIDE, ::_STRIDE, ::_STRIDE]
    field = np.full(labels.labels.shape, np.nan, dtype=np.float32)
    field[kept] = np.where(known, error, np.nan)
    field = field[::_STRIDE, ::_STRIDE, ::_STRIDE]
    field[np.isin(coarse, [number for number, name in labels.names.items() if name in RIGID])] = np.nan
    field -= np.nanmean(field)
    variance = float(np.nanmean(field**2))
    spacing = labels.grid.spacing_mm
    longest = [axis for axis in range(3) if spacing[axis] > spacing.max() - 1e-6]
    found = np.zeros(_LAGS)
    for lag in range(1, _LAGS + 1):
        products = []
        for axis in longest:
            ahead, behind = [slice(None)] * 3, [slice(None)] * 3
            ahead[axis], behind[axis] = slice(lag, None), slice(None, -lag)
            products.append(np.nanmean(field[tuple(ahead)] * field[tuple(behind)]))
        found[lag - 1] = float(np.mean(products)) / variance
    return found, _STRIDE * float(spacing.max()) * np.arange(1.0, _LAGS + 1)
