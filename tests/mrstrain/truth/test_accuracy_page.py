"""The page of an accuracy study: the answer stands before its picture, the picture before tables, and these are few."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.report.page import Section
from mrstrain.truth.accuracy_page import sections_of
from mrstrain.truth.accuracy_study import AccuracyStudy
from phantoms import (
    TISSUES,
    AccuracyCase,
    ErrorSamples,
    ResolutionRow,
    coverage_rows,
    error_rows,
    floor_rows,
    resolution_rows,
)
from tests.phantoms.test_error_tables import samples

USUAL = AccuracyCase("gauss-newton", (0.8, 0.8, 0.8), 25.0, "smooth", 1)
OF = {name: number for number, name in TISSUES.items()}


def in_three_tissues(case: AccuracyCase, offset: float = 0.0) -> ErrorSamples:
    """A third of the samples in each of fat, muscle and skin; the error is the offset, where there is strain."""
    one = samples(case, sd=0.0, offset=offset, count=3000)
    true = one.true_shear * (case.motion != "still")
    return replace(
        one,
        tissue=np.repeat([OF["fat"], OF["muscle"], OF["skin"]], 1000),
        true_shear=true,
        shear=true + np.float32(offset),
    )


def sections(runs: list[ErrorSamples], folder: Path, failures: dict[str, str] | None = None) -> list[Section]:
    tables = error_rows(runs), floor_rows(runs), resolution_rows(runs), coverage_rows(runs)
    return sections_of(*tables, failures or {}, folder)


@pytest.fixture
def runs() -> list[ErrorSamples]:
    """The usual condition comes second; on two heels, one motion has an error of 0.03 and another one of 0.04."""
    other = replace(USUAL, preset="heel-mr")
    return [
        in_three_tissues(other, 0.10),
        in_three_tissues(USUAL, 0.03),
        in_three_tissues(replace(USUAL, motion="Load1"), 0.04),
        in_three_tissues(replace(USUAL, seed=2), 0.03),
        in_three_tissues(replace(USUAL, motion="Load1", seed=2), 0.04),
        in_three_tissues(replace(USUAL, motion="still"), 0.01),
        in_three_tissues(replace(USUAL, motion="wave-24")),
    ]


def test_the_page_begins_with_the_answer_at_the_usual_condition(tmp_path: Path, runs: list[ErrorSamples]) -> None:
    """The error is over both motions, sqrt((.03^2 + .04^2) / 2), and the unloaded pair is the noise floor alone."""
    first, *others = sections(runs, tmp_path, {"a case": "a reason"})
    assert first.paragraphs == (
        "With gauss-newton (one smooth spline), voxels of 0.8 mm and SNR 25, the max. shear has an error (RMSE over 2 "
        "motions, with their range) of 0.035 (0.030 to 0.040) in fat, 0.035 (0.030 to 0.040) in muscle and 0.035 "
        "(0.030 to 0.040) in skin; the noise floor (median) is 0.010 in fat, 0.010 in muscle and 0.010 in skin.",
    )
    assert not first.folded
    assert first.pictures_first
    assert [picture.title for picture in first.pictures] == ["Error by true maximum shear strain"]
    of_condition, of_tissue = first.tables
    assert of_tissue.title.endswith("by tissue: gauss-newton, voxels of 0.8 mm, SNR 25")
    assert of_tissue.rows[0] == ("fat", 0.035, 0.035, 0.01, 0.01, 0.5)
    assert [row[0] for row in of_tissue.rows] == ["fat", "muscle", "skin"]
    assert {row[0]: row[3:] for row in of_condition.rows} == {
        "heel-mr": (0.1,) * 3, "gauss-newton": ("0.035 (0.010)",) * 3
    }  # fmt: skip
    assert all(len(table.columns) <= 6 for table in first.tables)
    assert [section.title.split(",")[0] for section in others] == [
        "By motion and tissue: heel-mr", "By motion and tissue: gauss-newton",
        "Spatial resolution", "Validation of the error model", "Failed cases",
    ]  # fmt: skip
    assert all(section.folded for section in others)


def test_no_picture_is_shown_twice_or_lost(tmp_path: Path, runs: list[ErrorSamples]) -> None:
    titles = [(s.title, picture.title) for s in sections(runs, tmp_path) for picture in s.pictures]
    assert len(set(titles)) == len(titles)
    assert sum("Error by" in picture for _, picture in titles) == 6


def test_a_study_without_strain_or_without_a_noise_floor_says_what_it_knows(tmp_path: Path) -> None:
    still, loaded = in_three_tissues(replace(USUAL, motion="still"), 0.01), in_three_tissues(USUAL, 0.03)
    floor = "the noise floor (median) is 0.010 in fat, 0.010 in muscle and 0.010 in skin."
    error = "the max. shear has an error (RMSE) of 0.030 in fat, 0.030 in muscle and 0.030 in skin."
    for run, says in ((still, floor), (loaded, error)):
        (sentence,) = sections([run], tmp_path)[0].paragraphs
        assert sentence == f"With gauss-newton (one smooth spline), voxels of 0.8 mm and SNR 25, {says}"
    assert sections([still], tmp_path)[0].pictures == ()  # rather than an empty one


def test_a_study_of_waves_alone_begins_with_their_resolution(tmp_path: Path) -> None:
    (only,) = sections([in_three_tissues(replace(USUAL, motion="wave-24"))], tmp_path)
    assert only.title == "Spatial resolution"
    assert not only.folded


def test_resolution_is_that_of_each_tissue_between_the_wavelengths_of_the_study(tmp_path: Path) -> None:
    """Waves of all tissues in one list gave the longest one for soft tissue: "90 % at 48 mm"."""
    condition = ("gauss-newton", "1.2", 15.0)
    found = {"fat": (0.86, 0.93, 0.98), "skin": (0.6, 0.79, 0.87), "soft tissue": (0.69, 0.896, 0.952)}
    rows = [
        ResolutionRow(*condition, tissue, *at)
        for tissue, of in found.items()
        for at in zip((12, 24, 48), of, strict=True)
    ]
    (only,) = sections_of((), (), rows, (), {}, tmp_path)
    (table,) = only.tables
    assert table.columns[3:6] == ("tissue", "90 % at, mm", "50 % at, mm")
    assert [row[3:6] for row in table.rows] == [("fat", 18, None), ("skin", None, None), ("soft tissue", 25, None)]


def test_the_terminal_begins_with_the_answer_of_the_page(tmp_path: Path, runs: list[ErrorSamples]) -> None:
    """Then the same for other presets at that condition, and how an engine with a label map is measured."""
    runs.append(in_three_tissues(replace(USUAL, spacing_mm=(1.2, 1.2, 1.2)), 0.2))
    study = AccuracyStudy.of(tmp_path, runs, {})
    usual, beside, labels, first, *_ = study.summary()
    (answer,) = sections(runs, tmp_path)[0].paragraphs
    assert usual == answer
    assert beside.startswith(
        "With heel-mr, voxels of 0.8 mm and SNR 25, the max. shear has an error (RMSE) of 0.100 in"
    )
    assert labels == (
        "gauss-newton fits one smooth spline, as `register --no-borders` does. By default, `register` uses "
        "gauss-newton-bone, or gauss-newton-borders with a label map; measure their error with `--preset`."
    )
    assert first == (
        "heel-mr, 0.8 mm, SNR 25, smooth: RMSE of the max. shear (bias): fat 0.100 (+0.100), muscle 0.100 (+0.100), "
        "skin 0.100 (+0.100)"
    )
    page = (tmp_path / "report.html").read_text()
    assert page.index("measure their error with") < page.index("<img")
    with_labels = in_three_tissues(replace(USUAL, preset="gauss-newton-borders"), 0.02)
    for measured in ([*runs, with_labels], runs[:1]):  # it was measured, or only another preset was
        assert not AccuracyStudy.of(tmp_path, measured, {}).one_spline


def test_the_sentence_precedes_the_picture_and_the_picture_every_table(
    tmp_path: Path, runs: list[ErrorSamples]
) -> None:
    AccuracyStudy.of(tmp_path, runs, {})
    page = (tmp_path / "report.html").read_text()
    assert page.index("has an error (RMSE over 2 motions") < page.index("<img") < page.index("<table")
    main = page[page.index("<main>") :]
    assert len(re.findall(r'<details id="part-\d+"[^>]* open>', main)) == 1
