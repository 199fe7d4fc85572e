"""What a function that leaves files has to tell of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Outcome:
    """Where results are, what is told of them, and whether all that was wanted was reached."""

    out: Path
    lines: tuple[str, ...]
    complete: bool = True

    def summary(self) -> list[str]:
        """A few lines for a person; where to look is the last."""
        return list(self.lines)


def with_reasons(what: str, reasons: Sequence[str]) -> str:
    """A sentence and its reasons: one follows it, several are listed below it, a line for each.

    >>> print(with_reasons("Every simulation failed.", ["Load1: it folds."]))
    Every simulation failed. Load1: it folds.
    >>> print(with_reasons("Every simulation failed.", ["Load1: it folds.", "Load2: no memory."]))
    Every simulation failed.
      Load1: it folds.
      Load2: no memory.
    """
    return " ".join([what, *reasons]) if len(reasons) < 2 else "\n  ".join([what, *reasons])
