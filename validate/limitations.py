"""What limits a comparison: the verdict on its inputs, and notes on its measurements and models."""

from collections.abc import Mapping, Sequence

import numpy as np

from dvc import Verdict
from dvc.trust.verdict import LEVELS, worst
from validate.load_comparison import LoadComparison

_COVERED = 0.9  # fraction of the mesh; a model that covers less is noted


def verdict_on(measured: Mapping[str, Verdict | None], warnings: Sequence[str] = ()) -> Verdict | None:
    """The verdict on the inputs of a comparison: the worst of the registrations' (by load) and of warnings on models.

    It lists all reasons below trust, the worst first. None where no registration has a verdict and there is no warning.
    """
    verdicts = [Verdict("caution", tuple(warnings))] if warnings else []
    for load, verdict in measured.items():
        if verdict is not None:
            what = "is not to be trusted" if verdict.level == "distrust" else "is to be used with care"
            reasons = tuple(f"{load}: its registration {what}: {reason}" for reason in verdict.reasons)
            verdicts.append(Verdict(verdict.level, () if verdict.level == "trust" else reasons))
    if not verdicts:
        return None
    distrust, caution = ([r for v in verdicts if v.level == level for r in v.reasons] for level in LEVELS[:0:-1])
    sound = f"The measurement: {len(verdicts)} registrations are sound. The models are compared below."
    return Verdict(worst(verdicts).level, (*distrust, *caution) or (sound,))


def doubts_of(verdict: Verdict | None) -> tuple[str, ...]:
    """Reasons of a verdict below trust."""
    return () if verdict is None or verdict.level == "trust" else verdict.reasons


def limitations(loads: Sequence[LoadComparison]) -> list[str]:
    """What the measurement of each load lacks, and which models cover little of the mesh, in sentences."""
    notes = []
    for one in loads:
        load, error, volumes = one.load, one.case.error, one.fields.coverage()
        if one.case.aligned_on == "none":
            notes.append(
                f"{load}: the bone's motion was not removed from this measurement: displacements are not the tissue's "
                "alone."
            )
        if error is not None and np.isnan(error.widening):
            notes.append(
                f"{load}: the coverage of its intervals is unknown (an error model of one subject): they are not "
                "widened."
            )
        notes += [
            f"{load}: {name} covers {volumes[name] / volumes['mesh']:.0%} of the mesh, and all models are scored on "
            "the tissue that every one covers."
            for name in one.fields.models
            if volumes[name] < _COVERED * volumes["mesh"]
        ]
    if unknown := [one.load for one in loads if one.case.error is None]:
        notes.append(
            f"{', '.join(unknown)}: the measurement uncertainty is unknown (no error_model.json beside the results): "
            "no difference counts as significant."
        )
    return notes
