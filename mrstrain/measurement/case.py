"""Loads that were measured and written: each a case, together a series with its report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import dvc
from dvc import Verdict
from dvc.atomic_files import write_json
from dvc.io.result_folder import PROVENANCE, REPEAT, REPORT
from dvc.report.page import Section, record_lines, write_report
from dvc.trust.verdict import worst
from mrstrain.measurement.acquisition import acquisition_section
from mrstrain.measurement.answer import MeasuredBeside, told_once

if TYPE_CHECKING:  # it draws, and matplotlib takes half a second: `Plan.register` loads it meanwhile
    from dvc import Measurement


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A measurement that was written: its folder, section of the report and summary, in place of its arrays."""

    folder: Path
    section: Section
    lines: tuple[str, ...]
    headline: str
    voxels: str = ""
    """Number and size of the voxels of its maps, in words."""

    @classmethod
    def of(cls, measurement: "Measurement", folder: Path, record: Mapping[str, object]) -> Self:
        """Write a measurement, with its provenance; its folder is there whole or not at all."""
        section, voxels = measurement.write(folder, record), str(measurement.maps.grid).partition("; ")[0]
        return cls(folder, section, tuple(measurement.summary()), measurement.headline, voxels)

    @property
    def name(self) -> str:
        """Name of the load."""
        return self.section.title

    @property
    def verdict(self) -> Verdict:
        """Verdict on the registration."""
        assert self.section.verdict is not None
        return self.section.verdict

    def measurement(self) -> "Measurement":
        """The measurement, read from its folder."""
        return dvc.Measurement.read(self.folder)

    def summary(self) -> list[str]:
        """The verdict with its reasons and the strain, for a person."""
        return list(self.lines)


_HOW_TO_READ = (
    "Displacement u(X) = x - X is that of the tissue relative to its bone: the rigid motion of the bone between the "
    "scans is removed. All maps are in the reference (unloaded) configuration, on the voxels of the unloaded image; "
    "components are in LPS (x to the patient's left, y to posterior, z to superior), lengths in mm.",
    "Strain is Green-Lagrange, E = (F^T F - I)/2 with F = I + du/dX, from the analytic gradient of the spline. "
    "The maximum shear strain is (E1 - E3)/2, half the difference of the largest and smallest principal strains. "
    "det F is the ratio of deformed to reference volume.",
    "The verdict concerns the registration, not the tissue. Sliding inside a uniform region or along a smooth skin "
    "leaves no trace in an image and cannot be detected. Noise raises small shear strains; a repeat scan without load "
    "(--repeat) shows by how much. Without a label map, a strain discontinuity between soft tissues is smoothed over "
    "about one control point spacing (3 to 5 mm); with one smooth spline, so is that at the bone. Scanner distortion "
    "and creep between scans are not detected.",
    "The noise floor is the apparent strain between two unloaded images. MAER is the mean over voxels of the mean "
    "absolute value of the six strain components, SDER the standard deviation of the same.",
    "Missing values are NaN in every map, never zero; valid.nii.gz marks the voxels with values. Programs built on ITK "
    "show NaN in NIfTI files as zero: use the NRRD file or the validity mask there.",
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
    advice : str or None
        What would lower the error, in a line.
    """

    out: Path
    cases: tuple[Case, ...]
    failures: dict[str, str]
    advice: str | None = None

    @classmethod
    def of(
        cls, out: Path, cases: tuple[Case, ...], failures: dict[str, str], record: Mapping[str, object],
        first: Sequence[Section] = (), more: Sequence[Section] = (), advice: str | None = None,
    ) -> Self:  # fmt: skip
        """Write the provenance of a series and its report, one self-contained page.

        The sections ``first`` come before those of the loads, which are then folded; ``more`` come last. The ``advice``
        stands below the verdict.
        """
        told = [case.section for case in cases]
        told += [Section(name, Verdict("distrust", (f"Not registered. {why}",))) for name, why in failures.items()]
        verdict = worst([s.verdict.among(s.title) if told[1:] else s.verdict for s in told if s.verdict is not None])
        write_json(out / PROVENANCE, record)
        folders = {case.name: case.folder for case in cases}
        beside = MeasuredBeside.of({name: folder for name, folder in folders.items() if name != REPEAT})
        short, first = told_once(first, verdict, beside)
        told = [*first, *(replace(section, folded=bool(first)) for section in told)]
        told += [replace(section, folded=True) for section in more]
        acquired = acquisition_section(folders)
        told += [] if acquired is None else [acquired]
        closing = (Section("How to read this", paragraphs=_HOW_TO_READ),)
        title, notes = "Strain from MR image pairs", [*_images(record, cases), *([] if advice is None else [advice])]
        lines = record_lines(record)
        write_report(out / REPORT, title, verdict, told, closing, lines, answer=short, notes=notes)
        return cls(out, cases, failures, advice)

    @property
    def complete(self) -> bool:
        """Whether no load failed."""
        return not self.failures

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = [line for case in self.cases for line in case.summary()]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, *([] if self.advice is None else [self.advice]), f"Report: {self.out / REPORT}"]


def _images(record: Mapping[str, Any], cases: Sequence[Case]) -> list[str]:
    """Which images a report is about, in a line, as far as its record tells."""
    inputs = record.get("inputs", {})
    names = ", ".join(file["name"] for role in ("load0", "loads", "repeat") for file in inputs.get(role, ()))
    voxels = next((case.voxels for case in cases if case.voxels), "")
    return [f"Images: {names}. Maps of {voxels}."] if names and voxels else []
