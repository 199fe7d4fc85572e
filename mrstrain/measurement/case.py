"""A load that was measured and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from dvc import Measurement, Verdict
from dvc.report.page import Section


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A measurement that was written: its folder, section of the report and summary, in place of its arrays."""

    folder: Path
    section: Section
    lines: tuple[str, ...]

    @classmethod
    def of(cls, measurement: Measurement, folder: Path, record: Mapping[str, object]) -> Case:
        """Write a measurement, with its provenance; its folder is there whole or not at all."""
        return cls(folder, measurement.write(folder, record), tuple(measurement.summary()))

    @property
    def name(self) -> str:
        """Name of the load."""
        return self.section.title

    @property
    def verdict(self) -> Verdict:
        """Verdict on the registration."""
        assert self.section.verdict is not None
        return self.section.verdict

    def measurement(self) -> Measurement:
        """The measurement, read from its folder."""
        return Measurement.read(self.folder)

    def summary(self) -> list[str]:
        """The verdict with its reasons and the strain, for a person."""
        return list(self.lines)
