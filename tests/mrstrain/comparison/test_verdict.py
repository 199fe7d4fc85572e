"""What is not to be trusted is said in everything that `compare` gives, and nothing is lost to what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import meshio
import numpy as np
import pytest

from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.trust.verdict import Verdict
from mrstrain.comparison.compare import Compared, compare
from tests.mrstrain.comparison.test_compare import given, rows, with_errors
from tests.validate.test_comparison import cube, sheared
from validate import Misfit
from validate.verdict import verdict_on


def judged(study: Path, **levels: str) -> None:
    for load, level in levels.items():
        verdict = {"level": level, "reasons": [] if level == "trust" else [f"The map of {load} folds."]}
        told = {"verdict": verdict, "alignment": {"on": "bone"}}
        (study / "measured" / load / "quality.json").write_text(json.dumps(told))


def done(study: Path, **more: object) -> Compared:
    return compare(study / "measured", [study / "half", study / "right"], **(given(study) | more))


def test_do_not_trust_is_said_in_everything(study: Path) -> None:
    with_errors(study, 0.0, 0.02)
    judged(study, Load1="trust", Load2="distrust")
    found = done(study)
    assert found.comparison.verdict is not None
    assert found.comparison.verdict.level == "distrust"
    reason = "Load2, registration (Do not trust): The map of Load2 folds."
    assert reason in found.comparison.notes
    summary = found.summary()
    assert summary[0] == "Measurement and model files: Do not trust"
    assert reason in summary
    over_all, first, second = found.comparison.ranking.statements
    assert over_all.endswith("It includes Load2, whose registration has the verdict Do not trust.")
    assert "Do not trust" not in first
    assert second.endswith("The registration of this load has the verdict Do not trust.")
    told = json.loads((study / "out" / "comparison.json").read_text())
    assert told["verdict"]["level"] == "distrust"
    assert told["verdict"]["reasons"][0] == reason
    assert told["verdict_by_load"]["Load2"] == {"level": "distrust", "reasons": ["The map of Load2 folds."]}
    assert told["verdict_by_load"]["Load1"]["level"] == "trust"
    for table in ("areas", "location", "agreement", "skin_displacement", "curves"):
        levels = {(r["load"], r["verdict"]) for r in rows(study / "out" / f"{table}.csv")}
        assert levels == {("Load1", "trust"), ("Load2", "distrust")} | (
            {("all loads", "distrust")} if table == "areas" else set()
        )
    alone = json.loads((study / "out" / "Load2" / "provenance.json").read_text())
    assert alone["verdict"]["level"] == "distrust"
    page = (study / "out" / "report.html").read_text().partition("<main>")[2]
    box = page.index('<div class="verdict distrust"><strong>Measurement')
    assert box < page.index("Models and loads") < page.index("Load2 (do not trust)")
    assert reason in page[box : page.index("Models and loads")]


def test_trust_is_in_the_measurement_alone_and_care_is_told_with_all_reasons(study: Path) -> None:
    sound = dict.fromkeys(("Load1", "Load2"), Verdict("trust"))
    assert verdict_on(sound) == Verdict(
        "trust",
        ("Both registrations passed all checks. The models are judged below, not here.",),
    )
    assert verdict_on(dict.fromkeys(sound)) is None
    odd = [Misfit("Load1", "turned", "It is mirrored."), Misfit("Load1", "far", "It is far away.", "distrust")]
    assert verdict_on(sound, odd[:1]) == Verdict("caution", ("It is mirrored.",))
    assert verdict_on(sound, odd) == Verdict("distrust", ("It is far away.", "It is mirrored."))
    # a model's displacement in the other frame than its mesh is a reason for care beside the registration's
    judged(study, Load1="distrust", Load2="caution")
    mesh = cube(6)
    (study / "turned").mkdir()
    bent = sheared(0.4).displacement(mesh.points_mm) * [-1.0, -1.0, 1.0]
    meshio.write(study / "turned" / "Load2.vtu", meshio.Mesh(mesh.points_mm, [("tetra", mesh.cells)], {"u": bent}))
    found = compare(study / "measured", [study / "right", study / "turned"], **given(study))
    assert found.comparison.verdict is not None
    assert found.comparison.verdict.level == "distrust"
    first, *others, last = found.comparison.verdict.reasons
    assert first.startswith("Load1, registration (Do not trust)")
    slips = [reason for reason in others if "far better with its components" in reason]
    assert [slip.split(" (cosine")[0] for slip in slips] == [
        "Load2: turned: the displacement fits the measured one far better with its components as x -y z"
    ]
    assert last.startswith("Load2, registration (Use with care)")
    section = found.sections[0]
    assert section.verdict is not None
    assert section.verdict.level == "caution"
    assert section.verdict.reasons == tuple(others)
    page = (study / "out" / "report.html").read_text()
    assert "<strong>Measurement and model files: Do not trust</strong>" in page


def test_what_is_refused_leaves_an_earlier_comparison_whole(plain, study: Path) -> None:
    shutil.copytree(plain.folder / "out", study / "out")
    kept = {p: p.read_bytes() for p in (study / "out").rglob("*") if p.is_file()}
    assert len(kept) > 10
    mesh = cube(4)
    aside = study / "aside.vtu"
    meshio.write(aside, meshio.Mesh(mesh.points_mm - [9.0, 0.0, 0.0], [("tetra", mesh.cells)]))
    far = study / "far.vtu"
    meshio.write(far, meshio.Mesh(mesh.points_mm - [-90.0, 0.0, 0.0], [("tetra", mesh.cells)]))
    field = study / "measured" / "Load2" / "displacement.nii.gz"
    whole = field.read_bytes()
    for more, error, message in (
        ({"bones": ["calcaneus"]}, InputError, "no label 'calcaneus'"),
        ({"mesh": study / "nowhere.vtu"}, (InputError, ImageFileError), "nowhere.vtu"),
        ({"mesh": aside}, GeometryError, "aside.vtu: only 50 % of the model lies in the labelled soft tissue"),
        ({"mesh": far}, GeometryError, "far.vtu does not lie in the image"),
        ({}, ImageFileError, "displacement.nii.gz"),
    ):
        field.write_bytes(whole if more else whole[: len(whole) // 2])
        with pytest.raises(error, match=message):
            done(study, **more)
        assert {p: p.read_bytes() for p in (study / "out").rglob("*") if p.is_file()} == kept
    assert np.isfinite(json.loads(kept[study / "out" / "comparison.json"])["total_area_ml"]["right"])
