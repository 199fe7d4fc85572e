"""The Gauss-Newton engine, with one smooth spline, and with strain that may jump at tissue interfaces."""

import json
import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.ndimage import binary_dilation

from dvc.deformation.protocol import Deformation
from dvc.errors import ParameterError
from dvc.images.tissue import bright_voxels
from dvc.registration.engine import AlignedPair, Cost, Displacement, Engine, Found, Progress
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.first_run import compile_beside, compile_loops
from dvc.registration.gauss_newton.fit import Parameters, fit
from dvc.registration.gauss_newton.with_interfaces import (
    NO_RIM,
    STAGE,
    STAGE_AT_BONE,
    USUAL_SKIN,
    fit_at_bone,
    fit_with_interfaces,
)
from dvc.worker import Worker

_log = logging.getLogger("dvc.registration")

_UNLABELLED = 0.1  # of the body: more than that was never in a phantom
_AT_BONE = "bone_alone"  # in a record: the bone's surface is the only interface
_NOTE = (
    "Strain may be discontinuous at the tissue interfaces of the label map. The bone of the rigid alignment is "
    "constrained to be rigid; its key results are those of the preceding smooth spline. If label boundaries are wrong "
    "by more than a voxel, use --no-borders (study file: borders = false). The whole motion, that of the bone "
    "included, is in transform.h5, as displacements at voxels. No elastix text files are written, because elastix has "
    "no spline with discontinuities."
)
_NOTE_AT_BONE = (
    "Strain may be discontinuous at the surface of the bone, which is constrained to be rigid. Where the unloaded "
    "image shows the dark rim of the bone, the surface of the mask was moved there, by up to 2.5 mean voxel edges; the "
    "key results of the bone are those of the preceding smooth spline. The whole motion, that of the bone included, is "
    "in transform.h5, as displacements at voxels. No elastix text files are written, because elastix has no spline "
    "with discontinuities."
)


@dataclass(frozen=True, slots=True)
class GaussNewton(Parameters, Engine):
    """One cubic B-spline for all tissues, fitted by Gauss-Newton steps.

    Attributes
    ----------
    spacing_mm : float
        Between control points, at the finest level; never less than two voxels.
    bending : float or None
        Weight of the bending, 1/mm; None: chosen for each pair by cross-validation. With a fixed weight there are no
        error bars.
    volume : float or None
        Weight of the volume change in soft tissue, 1/mm3; None: 300, unless the images indicate a volume change.
    rigidity : float
        Weight of strain in the bone, 1/mm3.

    Raises
    ------
    ParameterError
        For a spacing that is not above zero, or a weight that is negative or not finite.

    Notes
    -----
    `Measurement.sigma` and `.intervals` are available only for the parameters of the error model: `bending` chosen by
    cross-validation, the default spacing and rigidity, and `volume` None or 300. Otherwise
    `Measurement.error_bars.explanation` gives the reason. Repeat scans are always registered with a bending of 3/mm.
    """

    family = name = "gauss-newton"

    @property
    def unlike_its_error_model(self) -> str:
        """Why the error model of this name is not valid, if it was made with other parameters."""
        return _unlike(self.name, self)

    def of_repeat(self) -> Self:
        """With the default weights: weights chosen for a pair without strain would smooth away the noise floor."""
        return replace(self, bending=self.weights.bending, volume=self.weights.volume)

    def keeping_volume(self) -> Self:
        """With the weight of incompressible tissue, whatever the images indicate."""
        return replace(self, volume=self.weights.volume)

    def record(self) -> dict[str, object]:
        """Its parameters as plain values, for provenance."""
        return {"gauss_newton": asdict(self), "borders": None, "stages": []}

    @classmethod
    def methods(cls, record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        """Methods text from the parameters of a provenance record; empty if another engine was used."""
        own = record.get("gauss_newton")
        if not own or record.get("borders") is not None:
            return ""
        bending, volume = own.get("bending"), own.get("volume")
        weight = "chosen for each pair by cross-validation" if bending is None else f"{bending:g}/mm"
        by_rule = "300/mm3, or on its gradient alone where the images indicate such a change"
        kept = by_rule if volume is None else f"{volume:g}/mm3"
        held = f" and on volume change in the tissue ({kept})"
        if record.get("align") == "bone":
            rigid = f"strain of the bone ({own.get('rigidity'):g}/mm3)"
            held = f", on volume change in soft tissue ({kept}) and on {rigid}"
        return (
            f"with the Gauss-Newton engine of mrstrain {versions.get('mrstrain', '?')}: a cubic B-spline with control "
            f"points every {own.get('spacing_mm'):g} mm (or two voxels, if that is larger), fitted by least squares "
            "over all voxels of the tissue and 3 mm around it, with penalties on bending (the squared Laplacian of the "
            f"coefficients, reduced where the displacement is curved; weight {weight}){held}"
        )

    def prepare(self) -> None:
        """Compile the loops, if no run has done so before."""
        compile_loops(lambda pair: fit(pair, self))

    def prepare_beside(self) -> None:
        """Compile a part of them, if no run has done so before."""
        compile_beside(interfaces=False)

    def find(
        self, pair: AlignedPair, *, start: Deformation | None, seeds: Sequence[int], worker: Worker, progress: Progress
    ) -> Found:
        """Find the displacement between the images of a pair; as in `Engine`."""
        displacement, choice = _run(fit, pair, (self,), start, worker, progress)
        return Found(displacement, choice, _volume_freed(self.name, choice))


@dataclass(frozen=True, slots=True)
class GaussNewtonWithInterfaces(Engine):
    """Strain may be discontinuous at the interfaces of the tissues in a label map, and the bone is rigid.

    Attributes
    ----------
    smooth : GaussNewton
        The smooth spline that is fitted first, with the weights of both fits.
    skin : float or None
        Weight k of strain in the skin, 1/mm3; None: chosen for each pair by cross-validation.

    Raises
    ------
    ParameterError
        For a weight that is not above zero.
    """

    smooth: GaussNewton = GaussNewton()
    skin: float | None = None

    family, name, note = GaussNewton.family, "gauss-newton-borders", _NOTE
    needs_labels = True
    # 1.7 times as long as without (benchmarks/README.md); transform.h5 then holds displacements.
    cost = Cost(4.0, 4.4, phantom_seconds=52.0, gib_per_mvoxel=0.275, bytes_per_voxel=24.0)

    def __post_init__(self) -> None:
        if self.skin is not None and not (np.isfinite(self.skin) and self.skin > 0):
            raise ParameterError(f"The weight of strain in the skin must be above 0; got {self.skin}.")

    @property
    def text(self) -> str:
        """Every number that affects the result, as JSON: those of the smooth spline and of the last stage."""
        return json.dumps(json.loads(self.smooth.text) | {"borders": {"skin": self.skin} | STAGE})

    @property
    def unlike_its_error_model(self) -> str:
        """Why the error model of this name is not valid, if it was made with other parameters."""
        return _unlike(self.name, self.smooth)

    def of_repeat(self) -> Self:
        """With the default weights: weights chosen for a pair without strain would smooth away the noise floor."""
        return replace(self, smooth=self.smooth.of_repeat(), skin=self.skin or USUAL_SKIN)

    def keeping_volume(self) -> Self:
        """With the weight of incompressible tissue, whatever the images indicate."""
        return replace(self, smooth=self.smooth.keeping_volume())

    def record(self) -> dict[str, object]:
        """Its parameters as plain values, for provenance."""
        return self.smooth.record() | {"borders": {"skin": self.skin}}

    @classmethod
    def methods(cls, record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        """Methods text from the parameters of a provenance record; empty if another engine was used."""
        last = record.get("borders")
        smooth = GaussNewton.methods({**record, "borders": None}, versions)
        if not smooth or last is None or _AT_BONE in last:
            return ""
        skin, held = last.get("skin"), record.get("align") == "bone"
        weight = "chosen for each pair by cross-validation" if skin is None else f"{skin:g}/mm3"
        return (
            f"{smooth}; starting from this result, a second B-spline was added that vanishes on the tissue interfaces "
            f"of the label map, so that strain can be discontinuous there, with {'a rigid bone, ' if held else ''}a "
            f"penalty on the strain of a tissue named skin (weight {weight}), and bending measured by the Laplacian of "
            "the Laplacian of both splines"
        )

    def prepare(self) -> None:
        """Compile the loops, if no run has done so before."""
        compile_loops(lambda pair: fit_with_interfaces(pair, self.smooth))

    def prepare_beside(self) -> None:
        """Compile a part of them, if no run has done so before."""
        compile_beside(interfaces=True)

    def find(
        self, pair: AlignedPair, *, start: Deformation | None, seeds: Sequence[int], worker: Worker, progress: Progress
    ) -> Found:
        """Find the displacement between the images of a pair; as in `Engine`."""
        displacement, choice = _run(fit_with_interfaces, pair, (self.smooth, self.skin), start, worker, progress)
        return Found(displacement, choice, self.unlike_study(pair, choice))

    def unlike_study(self, pair: AlignedPair, choice: Choice) -> str:
        """Why its error model is not valid for a pair; empty if it is."""
        if pair.bone is None:
            return (
                f"The error of {self.name} was measured with a rigid bone; here the images were not aligned on a bone."
            )
        if choice.frees_volume or pair.labels is None:
            return _volume_freed(self.name, choice)
        body, labelled = pair.body.inside, pair.labels.labels > 0
        share = float(np.mean(~labelled[body]))
        if share > _UNLABELLED:  # air in a generous mask does not count, nor voxels that show a part of labelled tissue
            share = float(np.mean((bright_voxels(pair.fixed) & ~binary_dilation(labelled))[body]))
        if share <= _UNLABELLED:
            return ""
        return (
            f"{100 * share:.0f} % of the visible tissue has no label, but the error of {self.name} was measured with "
            "every tissue labelled. Label all tissue, or use one smooth spline (--no-borders)."
        )


@dataclass(frozen=True, slots=True)
class GaussNewtonAtBone(Engine):
    """Strain may be discontinuous at the surface of the bone, which is rigid; no label map is needed.

    The surface is that of the mask, moved to the outer edge of the bone's dark rim by up to 2.5 mean voxel edges. If
    the unloaded image shows hardly any rim, or slices are more than 2.1 times as thick as the other voxel edges, one
    smooth spline is fitted (`GaussNewton`); `Registration.settings` tells which engine was used.

    Attributes
    ----------
    smooth : GaussNewton
        The smooth spline that is fitted first, with the weights of both fits.
    """

    smooth: GaussNewton = GaussNewton()

    family, name, note = GaussNewton.family, "gauss-newton-bone", _NOTE_AT_BONE
    needs_bone = True
    cost = Cost(2.5, 3.2, phantom_seconds=42.0, gib_per_mvoxel=0.275, bytes_per_voxel=24.0)

    @property
    def may_be(self) -> tuple[str, ...]:
        """Names of the engines that may be used: its own, or that of one smooth spline."""
        return (self.name, self.smooth.name)

    @property
    def text(self) -> str:
        """Every number that affects the result, as JSON: those of the smooth spline and of the last stage."""
        return json.dumps(json.loads(self.smooth.text) | {"borders": {_AT_BONE: STAGE_AT_BONE}})

    @property
    def unlike_its_error_model(self) -> str:
        """Why the error model of this name is not valid, if it was made with other parameters."""
        return _unlike(self.name, self.smooth)

    def of_repeat(self) -> Self:
        """With the default weights: weights chosen for a pair without strain would smooth away the noise floor."""
        return replace(self, smooth=self.smooth.of_repeat())

    def keeping_volume(self) -> Self:
        """With the weight of incompressible tissue, whatever the images indicate."""
        return replace(self, smooth=self.smooth.keeping_volume())

    def record(self) -> dict[str, object]:
        """Its parameters as plain values, for provenance."""
        return self.smooth.record() | {"borders": {_AT_BONE: True}}

    @classmethod
    def methods(cls, record: Mapping[str, Any], versions: Mapping[str, str]) -> str:
        """Methods text from the parameters of a provenance record; empty if another engine was used."""
        smooth = GaussNewton.methods({**record, "borders": None}, versions)
        if not smooth or _AT_BONE not in (record.get("borders") or {}):
            return ""
        return (
            f"{smooth}; starting from this result, a second B-spline was added that vanishes on the surface of the "
            "bone, so that strain can be discontinuous there, with a rigid bone, whose surface was moved towards the "
            "outer edge of its dark rim in the unloaded image"
        )

    def prepare(self) -> None:
        """Compile the loops, if no run has done so before."""
        compile_loops(lambda pair: fit_with_interfaces(replace(pair, labels=None), self.smooth))

    def prepare_beside(self) -> None:
        """Compile a part of them, if no run has done so before."""
        compile_beside(interfaces=True)

    def find(
        self, pair: AlignedPair, *, start: Deformation | None, seeds: Sequence[int], worker: Worker, progress: Progress
    ) -> Found:
        """Find the displacement between the images of a pair; as in `Engine`. InputError without a bone."""
        displacement, choice = _run(fit_at_bone, replace(pair, labels=None), (self.smooth,), start, worker, progress)
        if choice.at_interfaces:
            return Found(displacement, choice, _volume_freed(self.name, choice))
        _log.warning(f"{NO_RIM}.")
        return Found(displacement, choice, _volume_freed(self.smooth.name, choice), self.smooth)


def _run(
    fitting: Callable[..., tuple[Displacement, Choice]], pair: AlignedPair, given: tuple[object, ...],
    start: Deformation | None, worker: Worker, tell: Progress,
) -> tuple[Displacement, Choice]:  # fmt: skip
    """Run a fit in the worker, which leaves the share that is done in a file."""
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        done = Path(folder) / "share done"
        done.write_text("0")

        def follow() -> None:
            if share := done.read_text():  # else it is being written
                tell("registering", float(share))

        found = worker.run(
            "registering with gauss-newton", fitting, pair.cut(), *given, start,
            lambda share: done.write_text(f"{share:.3f}"),
            watch=follow,
        )  # fmt: skip
    tell("registering", 1.0)
    return found


def _unlike(name: str, used: Parameters) -> str:
    """Why the error model of that name does not hold for other weights than its own."""
    if used.bending is None:
        return f"The error of {name} was measured with other weights than these."
    return (
        f"The error of {name} was measured with the bending weight chosen by cross-validation. Here it was fixed at "
        f"{used.bending:g}/mm, by your choice or because this is a repeat scan."
    )


def _volume_freed(name: str, choice: Choice) -> str:
    if not choice.frees_volume:
        return ""
    return (
        f"The error of {name} was measured on incompressible phantoms. Here incompressibility was relaxed, because the "
        "images indicate a volume change."
    )
