"""The accuracy study's tables as they stand in docs/engines.md and benchmarks/README.md, from its own CSV files.

    python -m benchmarks.accuracy_tables benchmarks/results/accuracy

Maximum shear strain, root mean square error; displacement in fat, root mean square error, mm.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from phantoms import ResolutionRow, wavelength_recovered

STRAINED = ("smooth", "sliding", "Load1", "Load3")
LOADED = ("smooth", "sliding", "Load1", "Load2", "Load3", "Load4")
TISSUES = ("fat", "muscle", "skin", "bone")
USUAL = ("0.8", 25.0)
CONDITIONS = (("0.8", 12.0), USUAL, ("0.8", 50.0), ("0.8 x 0.8 x 1.6", 25.0), ("1.2", 25.0))
TO_BONE = "distance to bone, mm"
LABEL_MAPS, BONE_MASKS = "label-maps", "bone-masks"
"""Folders of the registrations with masks that are right, too large and too small, each under every motion."""


@dataclass(frozen=True)
class Results:
    """Tables of one preset's study.

    Attributes
    ----------
    folder : Path
        With ``errors.csv``, ``zero_strain.csv``, ``coverage.csv``, and ``resolution.csv`` where there were waves.
    """

    folder: Path

    @cached_property
    def errors(self) -> list[dict[str, str]]:
        return self.table("errors.csv")

    def table(self, name: str) -> list[dict[str, str]]:
        path = self.folder / name
        return list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []

    def error(
        self,
        tissue: str,
        motions: Sequence[str] = STRAINED,
        condition: tuple[str, float] = USUAL,
        to_bone_mm: float | None = None,
        labels_off: int | None = None,
        column: str = "shear_rmse",
    ) -> float:
        """Mean over motions (and over label maps, where none is named)."""
        return mean(
            mean(
                float(row[column])
                for row in self.errors
                if (row["voxel_mm"], float(row["snr"])) == condition
                and (row["motion"], row["tissue"]) == (motion, tissue)
                and row["by"] == ("all" if to_bone_mm is None else TO_BONE)
                and (to_bone_mm is None or float(row["low"]) == to_bone_mm)
                and (labels_off is None or int(row["labels_off"]) == labels_off)
            )
            for motion in motions
        )

    def without_strain(self, condition: tuple[str, float], column: str) -> float:
        return mean(
            float(row[column])
            for row in self.table("zero_strain.csv")
            if (row["voxel_mm"], float(row["snr"])) == condition and row["tissue"] == "soft tissue"
        )

    def wavelength_mm(self, tissue: str, condition: tuple[str, float], share: float) -> float:
        """From which on a wave's shear is recovered to that share; NaN where it is not."""
        return wavelength_recovered(
            [
                ResolutionRow(row["preset"], *condition, tissue, float(row["wavelength_mm"]), float(row["recovered"]))
                for row in self.table("resolution.csv")
                if (row["voxel_mm"], float(row["snr"])) == condition and row["tissue"] == tissue
            ],
            share,
        )

    def coverage(self, condition: tuple[str, float]) -> tuple[float, float, float]:
        """Share of voxels within their interval: mean over motions and tissues, least, and most."""
        each = [
            float(row["voxels_within"])
            for row in self.table("coverage.csv")
            if (row["voxel_mm"], float(row["snr"])) == condition and row["voxels_within"] not in {"", "nan"}
        ]
        return mean(each), min(each, default=math.nan), max(each, default=math.nan)


def mean(values: Iterable[float]) -> float:
    each = list(values)
    return sum(each) / len(each) if each else math.nan


def told(value: float, digits: int = 3) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:.{digits}f}".replace("0.", ".", 1) if digits else f"{value:.0f}"


def show(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def of_engines(own: Results, other: Results) -> None:
    """Both engines without label maps."""

    def both(*given: object, **named: object) -> str:
        return f"{told(other.error(*given, **named))} -> {told(own.error(*given, **named))}"  # type: ignore[arg-type]

    show(
        "By motion, 0.8 mm, SNR 25: heel-mr -> gauss-newton",
        ("motion", "true p50 / p95 in fat", *TISSUES, "u"),
        (
            [
                motion,
                " / ".join(told(own.error("fat", [motion], column=c)) for c in ("true_p50", "true_p95")),
                *(both(tissue, [motion]) for tissue in TISSUES),
                both("fat", [motion], column="u_rmse_mm"),
            ]
            for motion in LOADED
        ),
    )
    show(
        "Fat by distance to bone, Load3, error / bias",
        ("from, mm", "heel-mr", "gauss-newton"),
        (
            [f"{low:g}"]
            + [
                f"{told(r.error('fat', ['Load3'], to_bone_mm=low))} / "
                f"{r.error('fat', ['Load3'], to_bone_mm=low, column='shear_bias'):+.3f}"
                for r in (other, own)
            ]
            for low in (0.0, 1.5, 3.0, 6.0, 12.0)
        ),
    )
    show(
        "By condition, gauss-newton (heel-mr)",
        ("voxel, SNR", *TISSUES, "u", "MAER", "SDER", "apparent shear, median"),
        (
            [f"{condition[0]} mm, {condition[1]:g}"]
            + [
                f"{told(own.error(t, condition=condition))} ({told(other.error(t, condition=condition))})"
                for t in TISSUES
            ]
            + [" (".join(told(r.error("fat", condition=condition, column="u_rmse_mm")) for r in (own, other)) + ")"]
            + [
                " (".join(told(r.without_strain(condition, c)) for r in (own, other)) + ")"
                for c in ("maer", "sder", "shear_p50")
            ]
            for condition in CONDITIONS
        ),
    )
    show(
        "Wavelength recovered to 90 / 50 %, mm, gauss-newton (heel-mr)",
        ("voxel, SNR", *TISSUES[:3]),
        (
            [f"{condition[0]} mm, {condition[1]:g}"]
            + [
                " (".join(
                    " / ".join(told(r.wavelength_mm(t, condition, share), 0) for share in (0.9, 0.5))
                    for r in (own, other)
                )
                + ")"
                for t in TISSUES[:3]
            ]
            for condition in CONDITIONS
        ),
    )


def of_borders(one: Results, borders: Results, each: Results, masks: Results) -> None:
    """With label maps beside without; ``each`` of them at one condition, and ``borders`` in turn at all; bone masks."""
    places = [("fat", None), ("fat", 0.0), ("fat", 1.5), ("muscle", None), ("skin", None), ("bone", None)]
    head = ("fat", "within 1.5 mm of bone", "from 1.5 to 3 mm", "muscle", "skin", "bone", "u")

    def row(results: Results, off: int | None, motions: Sequence[str], condition: tuple[str, float]) -> list[str]:
        return [
            *(told(results.error(t, motions, condition, near, off)) for t, near in places),
            told(results.error("fat", motions, condition, None, off, "u_rmse_mm")),
        ]

    for what, of in (("bone masks", masks), ("label maps", each)):
        ways = (("one spline", one, None), ("right", of, 0), ("too large", of, 1), ("too small", of, -1))
        show(
            f"With {what}, 0.8 mm, SNR 25",
            ("motion", what, *head),
            (
                [", ".join(motions), way, *row(results, off, motions, USUAL)]
                for motions in (*([m] for m in STRAINED), STRAINED)
                for way, results, off in ways
            ),
        )
    show(
        "Bias in fat within 1.5 mm of bone",
        ("motion", "one spline", "labels right"),
        (
            [m]
            + [
                f"{results.error('fat', [m], to_bone_mm=0.0, labels_off=off, column='shear_bias'):+.3f}"
                for _, results, off in ways[:2]
            ]
            for m in STRAINED
        ),
    )
    show(
        "Label maps: each at 0.8 mm, SNR 25; in turn elsewhere, and sliding and Load3 never get one that is too large",
        ("voxel, SNR", "", *head),
        (
            [f"{condition[0]} mm, {condition[1]:g}", name, *row(results, None, STRAINED, condition)]
            for condition in CONDITIONS
            for name, results in (("one spline", one), ("borders", each if condition == USUAL else borders))
        ),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    given = parser.parse_args()
    own, other, borders = (Results(given.results / n) for n in ("gauss-newton", "heel-mr", "gauss-newton-borders"))
    of_engines(own, other)
    of_borders(own, borders, Results(given.results / LABEL_MAPS), Results(given.results / BONE_MASKS))
    show(
        "Voxels whose truth lies within 1.96 standard deviations: mean, least, most",
        ("voxel, SNR", "gauss-newton", "heel-mr", "borders"),
        (
            [f"{condition[0]} mm, {condition[1]:g}"]
            + [" / ".join(told(c, 2) for c in r.coverage(condition)) for r in (own, other, borders)]
            for condition in CONDITIONS
        ),
    )


if __name__ == "__main__":
    main()
