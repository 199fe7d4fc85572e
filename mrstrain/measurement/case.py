"""Loads that were measured and written: each a case, together a series with its report."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from dvc import Measurement, Verdict
from dvc.atomic_files import write_json
from dvc.io.result_folder import PROVENANCE, REPORT
from dvc.report.page import Section, record_lines, write_report
from dvc.trust.verdict import worst


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A measurement that was written: its folder, section of the report and summary, in place of its arrays."""

    folder: Path
    section: Section
    lines: tuple[str, ...]

    @classmethod
    def of(cls, measurement: Measurement, folder: Path, record: Mapping[str, object]) -> Self:
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


_HOW_TO_READ = (
    "Displacement u(X) = x - X is that of tissue relative to its bone: the rigid motion of the bone between the scans "
    "is taken out. All maps are in the reference (unloaded) configuration, on the unloaded image's voxels; components "
    "are in LPS (x to the patient's left, y to posterior, z to superior), lengths in mm.",
    "Strain is Green-Lagrange, E = (F^T F - I)/2 with F = I + du/dX, from the analytic gradient of the cubic B-spline;"
    " maximal shear is (E1 - E3)/2, half the difference of the largest and smallest principal strain. det F is the "
    "ratio of deformed to reference volume.",
    "A verdict judges the registration, not the tissue. It cannot see everything: inside a uniform region, and along a"
    " smooth skin, an image does not show how tissue slides. Small shears are lifted by noise; a repeat scan without "
    "load (--repeat) tells by how much. Strain that jumps at a border of tissues is smeared over about one spacing of "
    "the control points (3 to 5 mm), unless a label map told where tissues meet. Scanner distortion and creep between "
    "scans are not seen at all.",
    "A noise floor is what a repeat scan shows where there is no strain. MAER is the mean over voxels of the mean "
    "absolute value of the six strain components, SDER the standard deviation of the same.",
    "Missing is NaN in every map, never zero; valid.nii.gz tells where values are. Programs built on ITK show NaN in "
    "NIfTI as zero: use the NRRD twin or the validity mask there.",
)


@dataclass(frozen=True, slots=True)
class Series:
    """Result of `register` and of `strain`.

    Attributes
    ----------
    out : Path
        Folder of all results; ``report.html`` is in it.
    cases : tuple of Case
        The measured loads, in the order given; the repeat scan last, if there is one.
    failures : dict
        Name of each load that could not be registered, and why.
    """

    out: Path
    cases: tuple[Case, ...]
    failures: dict[str, str]

    @classmethod
    def of(cls, out: Path, cases: tuple[Case, ...], failures: dict[str, str], record: Mapping[str, object]) -> Self:
        """Write the provenance of a series and its report, one self-contained page."""
        told = [case.section for case in cases]
        told += [Section(name, Verdict("distrust", (f"Not registered. {why}",))) for name, why in failures.items()]
        verdict = worst([s.verdict for s in told if s.verdict is not None])
        write_json(out / PROVENANCE, record)
        closing = (Section("How to read this", paragraphs=_HOW_TO_READ),)
        write_report(out / REPORT, "Strain from MR image pairs", verdict, told, closing, record_lines(record))
        return cls(out, cases, failures)

    @property
    def complete(self) -> bool:
        """Whether no load failed."""
        return not self.failures

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = [line for case in self.cases for line in case.summary()]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Report: {self.out / REPORT}"]
