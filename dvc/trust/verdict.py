"""A verdict on a result, in three levels and in words, with its reasons."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from dvc.errors import InputError

Level = Literal["trust", "caution", "distrust"]

LEVELS: tuple[Level, ...] = get_args(Level)
"""From the best to the worst."""
_WORDS: dict[Level, str] = {"trust": "Trust", "caution": "Use with care", "distrust": "Do not trust"}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a result, with reasons.

    Parameters
    ----------
    level : {"trust", "caution", "distrust"}
        From the best to the worst; in words "Trust", "Use with care", "Do not trust".
    reasons : tuple of str
        Full sentences, each with a value and its limits; at least one reason unless the level is "trust".

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
            raise InputError(f"The level of a verdict must be one of {list(LEVELS)}; got '{self.level}'.")
        if self.level != "trust" and not self.reasons:
            raise InputError(f"The verdict '{self.level}' needs at least one reason.")

    @property
    def words(self) -> str:
        """The level as people read it: "Trust", "Use with care", "Do not trust"."""
        return _WORDS[self.level]

    def among(self, load: str) -> "Verdict":
        """The same verdict for a list of several registrations: each reason names its load.

        >>> Verdict("distrust", ("It folds.",)).among("Load1").reasons
        ('Load1, registration (Do not trust): It folds.',)
        """
        return Verdict(self.level, tuple(f"{load}, registration ({self.words}): {reason}" for reason in self.reasons))

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        return {"level": self.level, "reasons": list(self.reasons)}


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The lowest level among verdicts, with the reasons of all at that level, each once.

    InputError where there is no verdict: nothing judged is not the same as nothing wrong.

    >>> worst([Verdict("trust"), Verdict("distrust", ("It folds.",))])
    Verdict(level='distrust', reasons=('It folds.',))
    """
    if not (given := list(verdicts)):
        raise InputError("No verdicts were given; assess at least one result first.")
    level = together(given).level
    return Verdict(level, tuple(dict.fromkeys(r for v in given if v.level == level for r in v.reasons)))


def together(findings: Iterable[Verdict]) -> Verdict:
    """The lowest level among findings with the reasons of all, in their order; trust where there is none.

    >>> together([Verdict("distrust", ("It folds.",)), Verdict("caution", ("Slices are 4 mm apart.",))]).reasons
    ('It folds.', 'Slices are 4 mm apart.')
    """
    given = [Verdict("trust"), *findings]
    level = max((v.level for v in given), key=LEVELS.index)
    return Verdict(level, tuple(reason for v in given for reason in v.reasons))
