"""The verdict on what a comparison rests on: the registrations, and the files of the models."""

from collections.abc import Mapping, Sequence

from dvc import Verdict
from dvc.report.page import MEASUREMENT, WITH_MODELS
from dvc.trust.verdict import LEVELS, worst
from validate.misfit import Misfit


def verdict_on(measured: Mapping[str, Verdict | None], warnings: Sequence[Misfit] = ()) -> Verdict | None:
    """The verdict on the inputs: the worst of the registrations' (by load) and of warnings on models; None without any.

    It lists the reasons of all verdicts below Trust, the worst first.
    """
    verdicts = [odd.verdict for odd in warnings]
    for load, verdict in measured.items():
        if verdict is not None:
            reasons = tuple(f"{load}, registration ({verdict.words}): {reason}" for reason in verdict.reasons)
            verdicts.append(Verdict(verdict.level, () if verdict.level == "trust" else reasons))
    if not verdicts:
        return None
    distrust, caution = ([r for v in verdicts if v.level == level for r in v.reasons] for level in LEVELS[:0:-1])
    registrations = {1: "The registration", 2: "Both registrations"}.get(
        len(verdicts), f"All {len(verdicts)} registrations"
    )
    sound = f"{registrations} passed all checks. The models are judged below, not here."
    return Verdict(worst(verdicts).level, (*distrust, *caution) or (sound,))


def judged_by(verdict: Verdict | None, measured: Mapping[str, Verdict | None]) -> str:
    """What a verdict is on: the measurement, or the model files as well, if its reasons are not the former's alone."""
    return MEASUREMENT if verdict == verdict_on(measured) else WITH_MODELS
