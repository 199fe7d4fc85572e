"""What a function that leaves files has to tell of them."""

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
