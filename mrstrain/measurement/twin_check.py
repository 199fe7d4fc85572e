"""The twin of a registered pair: the unloaded image, warped by the measured deformation and measured again."""

from collections.abc import Callable

import numpy as np

from dvc import Deformation, Registration, Subject, register, tissue_mask
from dvc.errors import InputError, MrstrainError
from dvc.images.noise import signal_to_noise
from dvc.measurement.error_bars import TwinCheck
from dvc.measurement.judgement import maps_of
from dvc.worker import Worker
from phantoms import Acquisition, synthetic_warp

_FOLDED = 1e-3


def twin_check(
    found: Registration, subject: Subject, start: Deformation | None, worker: Worker, tell: Callable[[str, float], None]
) -> TwinCheck:
    """Warp the unloaded image by the measured deformation, draw its noise anew, and register it as the pair was.

    The true strain of this twin is that of the pair's registration ``found``, which began at ``start``. The twin lies
    on the loaded image's grid, and is as noisy as the noisier of the two images.
    """
    tell("making the twin", 0.0)
    try:
        acquisition = Acquisition(found.settings.seed, found.loaded.grid, noise_factor=_noisier(found))
        near = found.alignment.motion
        twin = synthetic_warp(
            found.reference, found.tissue, found.total, acquisition, near=near, beyond_missing=True
        ).image
        tell("making the twin", 1.0)
        again = register(
            found.reference,
            twin,
            bone=subject.bone,
            tissue=found.tissue,
            labels=subject.labels,
            settings=found.settings,
            start=start,
            worker=worker,
            progress=lambda stage, fraction: tell(f"twin: {stage}", fraction),
        )
    except MrstrainError as reason:
        return TwinCheck(None, str(reason))
    maps = maps_of(again)
    folded = float(np.mean(maps.jacobian[found.tissue.inside] <= 0.0))
    if folded > _FOLDED:
        return TwinCheck(None, f"Its registration folds in {folded:.1%} of the tissue, so it tells nothing.")
    return TwinCheck(maps.max_shear)


def _noisier(found: Registration) -> float:
    """Noise-to-signal ratio of the loaded image relative to that of the unloaded one; at least 1."""
    try:
        loaded = signal_to_noise(found.loaded, tissue_mask(found.loaded))
    except InputError:  # no threshold finds the body there
        return 1.0
    return max(1.0, signal_to_noise(found.reference, found.tissue) / loaded)
