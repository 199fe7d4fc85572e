"""A verdict on a result, in three levels and in words, with its reasons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from dvc.errors import InputError

Level = Literal["trust", "caution", "distrust"]

LEVELS: tuple[Level, ...] = get_args(Level)
"""From the best to the worst."""
_WORDS: dict[Level, str] = {"trust": "Trust", "caution": "Use with care", "distrust": "Do not trust"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether a result may be used, and why (not).

    Parameters
    ----------
    level : {"trust", "caution", "distrust"}
    reasons : tuple of str
        Full sentences; a "trust" may have none.

    Raises
    ------
    InputError
        If the level is not one of the three, or a level below "trust" gives no reason.

    Examples
    --------
    >>> Verdict("caution", ("The images agree poorly.",)).words
    'Use with care'
    """

    level: Level
    reasons: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise InputError(f"A verdict is one of {list(LEVELS)}; got '{self.level}'.")
        if self.level != "trust" and not self.reasons:
            raise InputError(f"The verdict '{self.level}' needs a reason; give at least one sentence.")

    @property
    def words(self) -> str:
        """The level as people read it: "Trust", "Use with care", "Do not trust"."""
        return _WORDS[self.level]

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {"level": self.level, "reasons": list(self.reasons)}


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the lowest level among verdicts, with the reasons of all at that level, each told once.

    Raises
    ------
    InputError
        If there is no verdict: nothing judged is not the same as nothing wrong.

    Examples
    --------
    >>> worst([Verdict("trust"), Verdict("distrust", ("It folds.",))])
    Verdict(level='distrust', reasons=('It folds.',))
    """
    given = list(verdicts)
    if not given:
        raise InputError("There is no verdict to choose the worst of; judge at least one result first.")
    level = max((v.level for v in given), key=LEVELS.index)
    reasons = dict.fromkeys(r for v in given if v.level == level for r in v.reasons)
    return Verdict(level, tuple(reasons))


def together(findings: Iterable[Verdict]) -> Verdict:
    """Return the lowest level among findings with the reasons of all, in their order; trust where there is none.

    Examples
    --------
    >>> together([Verdict("distrust", ("It folds.",)), Verdict("caution", ("Slices are 4 mm apart.",))]).reasons
    ('It folds.', 'Slices are 4 mm apart.')
    """
    given = [Verdict("trust"), *findings]
    level = max((v.level for v in given), key=LEVELS.index)
    return Verdict(level, tuple(reason for v in given for reason in v.reasons))


def verdict_on_loads(by_load: Mapping[str, Verdict], strange: Sequence[str] = ()) -> Verdict | None:
    """The verdict on a comparison with measured loads: the worst of theirs, and of what is ``strange`` about models.

    All reasons for less than trust are told, the worst first; trust is said to be in the measurement, and not in the
    models. None where no load has a verdict and nothing is strange.
    """
    given = [Verdict("caution", tuple(strange))] if strange else []
    for load, verdict in by_load.items():
        what = "is not to be trusted" if verdict.level == "distrust" else "is to be used with care"
        told = tuple(f"{load}: its registration {what}: {reason}" for reason in verdict.reasons)
        given.append(Verdict(verdict.level, () if verdict.level == "trust" else told))
    if not given:
        return None
    reasons = {level: [r for v in given if v.level == level for r in v.reasons] for level in ("distrust", "caution")}
    sound = f"The measurement: {len(given)} registrations are sound. The models are judged below."
    return Verdict(worst(given).level, (*reasons["distrust"], *reasons["caution"]) or (sound,))
