"""`demo`: a heel phantom whose strain is known is registered like any pair, and the error is told by tissue."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path

from dvc.deformation import Composed
from dvc.imagewrite import write_image, write_labels, write_mask
from dvc.labels import read_mask
from dvc.report import Section, Table
from dvc.transformfile import read_transform
from dvc.whole import write_whole
from mrstrain.page import write_series_report
from mrstrain.registering import Series, register
from phantoms.heel import HeelPair, heel_pair
from phantoms.score import TissueError, errors_by_tissue

_LOAD = 1.0
_FIGURES = ("true_p50", "true_p95", "shear_rmse", "shear_bias", "u_p50_mm", "u_p95_mm")


def demo(out: Path | str, *, seed: int = 1, progress: Callable[[str, str, float], None] | None = None) -> list[str]:
    """Make a heel phantom pair with a repeat scan, register it, and compare with the truth.

    Parameters
    ----------
    out : path
        Gets ``images`` (the phantom's files), ``results`` (what `register` writes) and ``error.csv``.
    seed : int
        Of the phantom.

    Returns
    -------
    list of str
        The error by tissue and the report's path, line by line.
    """
    target = Path(out)
    images = target / "images"
    images.mkdir(parents=True, exist_ok=True)
    tell = progress or (lambda *_: None)
    tell("phantom", "images", 0.0)
    pair = heel_pair(seed=seed, load=_LOAD)
    for name, image in (("Load0", pair.reference), ("Load1", pair.loaded), ("Load0-again", pair.repeat)):
        write_image(images / f"{name}.nii.gz", image)
    write_mask(images / "calcaneus.nii.gz", pair.bone)
    write_labels(images / "tissues.nii.gz", pair.labels)
    tell("phantom", "images", 1.0)
    results = register(
        images / "Load0.nii.gz",
        [images / "Load1.nii.gz"],
        out=target / "results",
        bone=images / "calcaneus.nii.gz",
        labels=images / "tissues.nii.gz",
        names=images / "tissues.csv",
        repeat=images / "Load0-again.nii.gz",
        progress=progress,
    )
    if results.failures:
        return results.summary()
    errors = _errors(pair, target / "results" / "Load1")
    _write_table(target / "error.csv", errors)
    _report(target / "results", errors, results)
    lines = ["Error against the phantom's known truth (maximal shear; displacement in mm):"]
    lines.append(f"{'tissue':<10}{'true median':>12}{'true p95':>10}{'RMSE':>8}{'bias':>8}{'u median':>10}{'u p95':>8}")
    widths = (12, 10, 8, 8, 10, 8)
    for error in errors:
        numbers = "".join(f"{getattr(error, k):>{w}.3f}" for k, w in zip(_FIGURES, widths, strict=True))
        lines.append(f"{error.tissue:<10}{numbers}")
    return [*lines, *results.summary()]


def _write_table(path: Path, errors: Sequence[TissueError]) -> None:
    table = io.StringIO()
    writer = csv.DictWriter(table, [f.name for f in fields(TissueError)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(error) for error in errors)
    write_whole(path, table.getvalue())


def _report(folder: Path, errors: Sequence[TissueError], results: Series) -> None:
    """Write the report anew, with the error against the truth ahead of the measurement."""
    section = Section(
        "Error against the truth",
        tables=(
            Table(
                "Maximal shear and displacement, by tissue",
                ("tissue", "true shear, median", "true shear, p95", "RMSE", "bias", "u error, median", "u error, p95"),
                tuple(tuple(getattr(error, key) for key in ("tissue", *_FIGURES)) for error in errors),
                note="Displacement in mm. The calcaneus and the ankle's bones are rigid: their true shear is zero.",
            ),
        ),
        paragraphs=(
            "These images are a phantom: the strain is known at every point, so the measurement below can be compared "
            "with the truth, wherever it has a result. Real images have no such table; the verdict and the repeat scan "
            "stand in for it.",
        ),
    )
    record = json.loads((folder / "provenance.json").read_text(encoding="utf-8"))
    cases = [case.section for case in results.cases]
    write_series_report(folder / "report.html", [section, *cases], results.failures, record)


def _errors(pair: HeelPair, folder: Path) -> tuple[TissueError, ...]:
    """Error by tissue, of the transform as it was written, where the result is valid."""
    whole = read_transform(folder / "TransformParameters.1.txt")
    of_tissue = Composed([whole, pair.foot_motion.inverse()])
    valid = read_mask(folder / "valid.nii.gz").inside
    return errors_by_tissue(pair.labels, pair.deformation, of_tissue, valid)
