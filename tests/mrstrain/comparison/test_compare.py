"""`compare` from files to report: loads matched by name, partial ones left out, one self-contained page."""

from __future__ import annotations

import csv
import html
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import meshio
import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.errors import GeometryError, InputError, OutputError
from dvc.images.image import LabelMap
from dvc.io.images.write import write_labels
from mrstrain.cli.app import app
from mrstrain.comparison.compare import compare
from mrstrain.records.provenance import file_hash, provenance
from tests.dvc.report.test_page import unpacked
from tests.validate.test_comparison import cube, error_table, labels, sheared

LOADS = {"Load1": 0.8, "Load2": 0.4}


def given(study: Path) -> dict[str, object]:
    plate = {"plate_normal": (1.0, 0.0, 0.0), "shear_direction": (0.0, 1.0, 0.0)}
    return {"labels": study / "tissues.nii.gz", "names": study / "tissues.csv", "out": study / "out"} | plate


def rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def with_errors(study: Path, bias: float, sd: float) -> None:
    from dvc.trust.error_model import ErrorModel

    for load in LOADS:
        ErrorModel("heel-mr", "0", (error_table(bias, sd),), "test").write(
            study / "measured" / load / "error_model.json"
        )


def test_a_tissue_without_intervals_in_the_measurement_has_none_in_the_comparison(study: Path) -> None:
    with_errors(study, 0.0, 0.02)
    for load in LOADS:
        numbers = {"skin": "0.1,0.1,,", "fat": "0.1,0.1,0.08,0.12"}
        lines = [f"{tissue},median,{of.replace(',,', ',nan,nan')},Trust" for tissue, of in numbers.items()]
        head = "region,statistic,found,estimate,low,high,verdict"
        (study / "measured" / load / "intervals.csv").write_text("\n".join([head, *lines]) + "\n")
    done = compare(study / "measured", [study / "half"], **given(study))
    areas = {(r["model"], r["load"], r["tissue"]): r for r in rows(study / "out" / "areas.csv")}
    of_skin, of_fat = (areas["half", "Load1", tissue] for tissue in ("skin", "fat"))
    assert np.isnan(float(of_skin["low_ml"]))
    assert not np.isnan(float(of_fat["low_ml"]))
    assert {r["tissue"] for r in rows(study / "out" / "decomposition.csv")} == {"fat"}
    assert "Load1: no intervals in skin; the report of the measurement says why." in done.comparison.notes


def test_models_are_ranked_and_everything_is_written(study: Path) -> None:
    with_errors(study, 0.0, 0.02)
    done = compare(study / "measured", [study / "half", study / "right"], on_image=True, **given(study))
    assert [a.model for a in done.comparison.ranking.areas] == ["right", "half"]
    assert done.comparison.ranking.areas[0].ml == pytest.approx(0.0, abs=1e-3)
    statements = done.comparison.ranking.statements
    (best,) = [
        one for one in statements if one.startswith("Best match over all loads (area metric): right, significantly")
    ]
    area = done.comparison.ranking.areas[0]
    between = "Area between its strain-volume curve and the measured one, max. shear 0.2 to 0.5, summed over the loads"
    assert f"{between}: {area.best_ml:.2f} mL (95 % interval {area.low_ml:.2f} to {area.high_ml:.2f}); " in best
    areas = {(r["model"], r["load"], r["tissue"]): r for r in rows(study / "out" / "areas.csv")}
    # all 8 mL are above 0.2 to 0.43 by the measurement, and to 0.204 by the model, minus what lies at the border
    volume = json.loads((study / "out" / "comparison.json").read_text())["coverage_ml"]["Load1"]["common"]
    expected = volume * (np.hypot(0.8, 0.32) - np.hypot(0.4, 0.08)) / 2.0
    found = areas["half", "Load1", "all soft tissue"]
    assert float(found["ml"]) == pytest.approx(expected, rel=1e-3)
    assert float(found["low_ml"]) < expected < float(found["high_ml"])
    assert float(areas["half", "Load1", "fat"]["ml"]) == pytest.approx(expected / 2.0, rel=0.05)
    # a model that predicts nothing has the measured curve itself as its area, from 0.2 on; it stands below the others
    nothing = areas["no deformation", "Load1", "all soft tissue"]
    assert float(nothing["ml"]) == pytest.approx(volume * (np.hypot(0.8, 0.32) / 2.0 - 0.2), rel=1e-3)
    assert float(nothing["low_ml"]) < float(nothing["ml"]) < float(nothing["high_ml"])
    page = (study / "out" / "report.html").read_text()
    foot = page.index("<tfoot>")
    assert foot < page.index("no deformation", foot) < page.index("</tfoot>")
    assert not any("no deformation" in sentence for sentence in statements)
    places = {(r["model"], r["load"], r["threshold"]): r for r in rows(study / "out" / "location.csv")}
    right = places["right", "Load1", "0.3"]
    assert float(right["measured_low_ml"]) <= float(right["measured_ml"]) <= float(right["measured_high_ml"])
    assert float(right["dice_high"]) == 1.0
    assert float(right["dice_perfect"]) > 0.95
    assert float(places["half", "Load1", "0.3"]["dice_high"]) < 0.5
    skin = {(r["model"], r["load"]): r for r in rows(study / "out" / "skin_displacement.csv")}
    assert float(skin["right", "Load1"]["model_along_mm"]) >= 0.0
    for load, gamma in LOADS.items():
        names = {p.name for p in (study / "out" / load).iterdir()}
        assert names >= {
            "fields.vtu",
            "curves.png",
            "slices.png",
            "agreement.png",
            "agreement.pdf",
            "agreement.csv",
            "differences_shear.csv",
            "differences_u.csv",
            "right_max_shear.nii.gz",
            "provenance.json",
        }
        fields = meshio.read(study / "out" / load / "fields.vtu").cell_data
        inside = fields["compared"][0] == 1.0
        bins = rows(study / "out" / load / "agreement.csv")
        assert {row["model"] for row in bins} == {"right", "half"}
        tissue = [sum(float(row["volume_ml"]) for row in bins if row["model"] == name) for name in ("right", "half")]
        assert tissue == pytest.approx([volume, volume], rel=0.01)  # it ends at the 99.5th percentile
        half = [(float(r["simulated_max_shear"]), float(r["volume_ml"])) for r in bins if r["model"] == "half"]
        values, weights = zip(*half, strict=True)
        middle = np.average(values, weights=weights)
        assert middle == pytest.approx(0.5 * np.hypot(gamma / 2, gamma**2 / 8), abs=0.01)
        assert fields["half_max_shear"][0][inside] == pytest.approx(0.5 * np.hypot(gamma / 2, gamma**2 / 8))
    curves = [
        r
        for r in rows(study / "out" / "curves.csv")
        if (r["load"], r["tissue"], r["field"]) == ("Load2", "fat", "half")
    ]
    above = {float(r["max_shear"]): float(r["volume_above_ml"]) for r in curves}
    assert above[0.1] == pytest.approx(volume / 2.0, rel=0.05)
    assert above[0.105] == 0.0
    assert {r["quantity"] for r in rows(study / "out" / "agreement.csv")} == {"max_shear", "u_mm"}
    assert {float(r["threshold"]) for r in rows(study / "out" / "location.csv")} == {0.2, 0.3, 0.5}


def test_the_report_needs_nothing_else_and_says_what_it_rests_on(plain) -> None:
    page = (plain.folder / "out" / "report.html").read_text()

    class Fetched(HTMLParser):
        def __init__(self) -> None:
            super().__init__()
            self.found: list[str] = []

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.found += [
                v or "" for k, v in attrs if k in ("src", "href") and not (v or "").startswith(("data:", "#"))
            ]

    parser = Fetched()
    parser.feed(page)
    assert parser.found == []
    assert len(re.findall("<figure>", page)) == 5 * len(LOADS) + 2
    assert page.count("Agreement by distance to bone") == len(LOADS)
    assert page.count("The slice goes through the point of the bone nearest to the plate.") == len(LOADS)
    assert len(re.findall('<figure class="viewer">', page)) == len(LOADS)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None
    assert "default-src 'none'" in html.unescape(policy[1])
    assert "http" not in policy[1]
    volumes = dict(re.findall(r'id="(volume-\d+)">([^<]*)<', page))
    overlays = re.findall(r'class="overlay" data-volume="([^"]*)" data-title="([^"]*)"', page)
    held = {name: volumes[which] for which, name in overlays}
    right, measured = (unpacked(held[name]) for name in ("right", "measured"))
    middle = right.get_fdata()[tuple(n // 2 for n in right.shape)]
    assert middle == pytest.approx(0.5 * np.hypot(0.4, 0.08), abs=0.005)  # the last of the loads, "Load2"
    assert measured.get_fdata()[tuple(n // 2 for n in right.shape)] == pytest.approx(middle, abs=0.005)
    corner = right.affine @ [4, 4, 4, 1]  # RAS: x and y turn their sign
    assert corner[:3].tolist() == [-0.5, -0.5, 0.5]
    text = re.sub(r"\s+", " ", page)
    assert "values are as measured and have no intervals" in text
    assert "the displacement was used as given" in text
    assert "measurement uncertainty is unknown" in text
    assert text.index("Models and loads") < text.index("Strain-volume curves, all soft tissue")


def test_without_an_error_no_difference_counts_as_seen(plain, study: Path) -> None:
    ranking = plain.done.comparison.ranking
    assert ranking.statements == ()
    assert np.isnan(ranking.areas[0].low_ml)
    assert set(ranking.not_distinguishable.values()) == {(("right", "half"),)}
    assert "<td>1–2</td>" in (plain.folder / "out" / "report.html").read_text()
    with_errors(study, 0.0, 5.0)  # a measurement that knows nothing
    done = compare(study / "measured", [study / "right", study / "half"], **given(study))
    assert done.comparison.ranking.statements[0].startswith(
        "Best match over all loads (area metric): right; not distinguishable from half. "
    )


def test_loads_that_models_did_not_carry_or_whose_laws_are_unstable_are_told(study: Path) -> None:
    for model, load1 in (("half", {"reached": 0.42}), ("right", {"reached": 1.0, "stable_share": 0.9})):
        outcome = {"Load1": load1, "Load2": {"reached": 1.0, "stable_share": 1.0}}
        (study / model / "simulation.json").write_text(json.dumps({"outcome": outcome, "parameters": {}}))
    done = compare(study / "measured", [study / "right", study / "half"], **given(study))
    assert "half reached only 42 % of Load1; this load is not compared." in done.comparison.notes
    assert [a.model for a in done.comparison.ranking.areas] == ["right"]
    assert [sorted(one.fields.models) for one in done.comparison.loads] == [["right"], ["half", "right"]]
    (told,) = [note for note in done.comparison.notes if "not stable (Drucker)" in note]
    assert told.startswith("right, Load1:")
    assert "10.0 %" in told


def test_a_load_is_looked_at_along_its_own_directions(study: Path) -> None:
    """Of a shear along y the plate across x moves 'along', that across y goes in."""
    own = {"Load2": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0))}
    compare(study / "measured", [study / "right"], **given(study), towards=own)
    skin = {r["load"]: r for r in rows(study / "out" / "skin_displacement.csv")}
    usual, aside = (float(skin[load]["model_along_mm"]) for load in LOADS)
    assert usual > 0.5
    assert aside < 0.05
    told = json.loads((study / "out" / "comparison.json").read_text())["parameters"]
    assert list(told["plate_axes_lps_of"]) == ["Load2"]
    assert np.array(told["plate_axes_lps_of"]["Load2"])[:, 0] == pytest.approx([0.0, -1.0, 0.0])


def test_a_model_that_lies_elsewhere_or_is_strange_is_refused_or_told(study: Path) -> None:
    mesh = cube(6)

    def written(name: str, points: np.ndarray, u: np.ndarray) -> Path:
        (study / name).mkdir()
        for load in LOADS:
            meshio.write(
                study / name / f"{load}.vtu", meshio.Mesh(points, [("tetra", mesh.cells)], {"displacement": u})
            )
        return study / name

    u = sheared(0.4).displacement(mesh.points_mm)
    off = written("off", mesh.points_mm - [6.0, 0.0, 0.0], u)  # a third of it in the bone
    with pytest.raises(GeometryError, match=r"only \d+ % of the model lies in the labelled soft tissue"):
        compare(study / "measured", [off], **given(study))
    assert not (study / "out").exists()
    a_bit = written("a bit", mesh.points_mm - [2.0, 0.0, 0.0], u)
    moving = written("moving", mesh.points_mm, u + np.array([3.0, 0.0, 0.0]))
    swollen = written("swollen", mesh.points_mm, 0.1 * mesh.points_mm)
    done = compare(study / "measured", [a_bit, moving, swollen], loads=["Load1"], **given(study))
    for name, words in (
        ("a bit", "check its frame"),
        ("moving", "mm at the bone"),
        ("swollen", "mean change of cell volume is 33 %"),
    ):
        assert any(name in note and words in note for note in done.comparison.notes), (name, done.comparison.notes)


def test_each_model_may_have_a_unit_frame_and_mesh_of_its_own(study: Path) -> None:
    from tests.validate.test_fe_result import table

    mesh = cube(6)
    (study / "ansys").mkdir()
    turned = 1e-3 * mesh.points_mm * [-1.0, -1.0, 1.0]
    meshio.write(study / "ansys" / "heel.vtu", meshio.Mesh(turned, [("tetra", mesh.cells)]))
    for load, gamma in LOADS.items():
        u = 1e-3 * sheared(gamma).displacement(mesh.points_mm) * [-1.0, -1.0, 1.0]
        table(study / "ansys" / f"{load}.csv", np.arange(len(turned)), u)
    settings = study / "ansys" / "model.toml"
    settings.write_text('mesh = "heel.vtu"\nunit = "m"\nframe = "RAS"\n')
    done = compare(study / "measured", [study / "half", study / "ansys"], loads=["Load1"], **given(study))
    assert done.comparison.ranking.areas[0].model == "ansys"
    assert done.comparison.ranking.areas[0].ml == pytest.approx(0.0, abs=1e-3)
    settings.write_text('units = "m"\n')
    with pytest.raises(InputError, match="unknown key 'units'; the keys are mesh, unit, frame, to_image"):
        compare(study / "measured", [study / "ansys"], **given(study))


def test_nothing_old_stands_beside_what_is_new(plain, study: Path) -> None:
    shutil.copytree(plain.folder / "out", study / "out")
    assert (study / "out" / "Load2").is_dir()
    (study / "out" / "notes.txt").write_text("mine")
    compare(study / "measured" / "Load1", [study / "half"], **given(study))
    assert {p.name for p in (study / "out").iterdir() if p.is_dir()} == {"Load1"}
    assert (study / "out" / "notes.txt").is_file()
    for place in (study / "measured", study / "half"):
        with pytest.raises((InputError, OutputError), match=r"hoose another (out )?folder"):
            compare(study / "measured", [study / "half"], **(given(study) | {"out": place}))


def test_the_command_takes_one_load_and_one_file(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # in a process of its own
    out = study / "one"
    argv = ["compare", study / "measured" / "Load1", study / "half" / "Load1.vtu", "--labels", study / "tissues.nii.gz"]
    argv += ["--names", study / "tissues.csv", "--out", out, "--strains", "0.1", "0.4"]
    ran = CliRunner().invoke(app, [str(a) for a in argv])
    assert ran.exit_code == 0, ran.output
    assert "Load1: area between strain-volume curves (max. shear 0.1 to 0.4), mL, best first: half" in ran.output
    assert (out / "report.html").is_file()


def test_what_was_measured_with_is_not_asked_for_again(study: Path) -> None:
    load = study / "measured" / "Load1"
    files = {"labels": study / "measured.nii.gz", "names": study / "measured.csv"}  # no other test has such files
    shutil.copy(study / "tissues.nii.gz", files["labels"])
    shutil.copy(study / "tissues.csv", files["names"])
    axes = {"plate_normal_lps": (1.0, 0.0, 0.0), "shear_direction_lps": (0.0, 1.0, 0.0)}
    (load / "provenance.json").write_text(json.dumps(provenance("register", files, axes | {"bone_label": "bone"})))
    argv = ["compare", load, study / "half" / "Load1.vtu", "--out", study / "one"]
    ran = CliRunner().invoke(app, [str(a) for a in argv])
    assert ran.exit_code == 0, ran.output
    given = f"--labels {files['labels']} --names {files['names']} --bone bone .*--plate-normal 1 0 0"
    taken = re.compile(f"From the record of {load}: .*{given} --shear-direction 0 1 0 ")
    said, at_the_start = (" ".join(stream.split()) for stream in (ran.stdout, ran.stderr))
    assert not taken.search(said)  # once, before the work
    assert taken.match(at_the_start)
    told = json.loads((study / "one" / "comparison.json").read_text())
    for role, path in files.items():  # as if they had been given
        assert told["inputs"][role] == [{"name": path.name, "sha256": file_hash(path)}]
    assert np.array(told["parameters"]["plate_axes_lps"])[:, :2].T.tolist() == [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    files["labels"].write_bytes(b"another")
    ran = CliRunner().invoke(app, [str(a) for a in argv])
    assert isinstance(ran.exception, InputError)
    assert "(--labels)" in str(ran.exception)


def test_what_does_not_fit_is_refused_before_anything_is_written(study: Path) -> None:
    right = study / "right"
    for measured, models, error, message in (
        (study, [right], InputError, "no results of `mrstrain register`"),
        (study / "measured", [], InputError, "No model is given"),
        (study / "measured", [study / "nobody"], InputError, "no such file or folder"),
        (study / "measured", [right, right / "Load1.vtu"], InputError, "Two models are named 'right'"),
        (study / "measured", [study / "measured"], InputError, "no file of a measured load"),
    ):
        with pytest.raises(error, match=message):
            compare(measured, models, **given(study))
    for more, error, message in (
        ({"bones": ["calcaneus"]}, InputError, "no label 'calcaneus'"),
        ({"strains": (0.5, 0.2)}, InputError, "must increase"),
        ({"strains": (20, 50)}, InputError, "not in percent"),
        ({"model_unit": "m"}, (GeometryError, InputError), "too large for a body part"),
        ({"model_frame": "RAS"}, GeometryError, "the other frame"),
    ):
        with pytest.raises(error, match=message):
            compare(study / "measured", [right], **(given(study) | more))
    assert not list((study / "out").glob("*/*")) if (study / "out").exists() else True


def test_tissue_without_bone_is_compared_and_its_report_leaves_out_what_needs_bone(study: Path) -> None:
    with_errors(study, 0.0, 0.02)
    tissues = labels()
    soft = LabelMap(tissues.grid, np.where(tissues.labels == 3, 0, tissues.labels), {1: "fat", 2: "skin"})
    write_labels(study / "tissues.nii.gz", soft)
    (study / "tissues.csv").write_text("label,name\n1,fat\n2,skin\n")
    told = list[tuple[str, str, float]]()
    models, only = [study / "half", study / "right"], {"loads": ["Load1"], "progress": lambda *one: told.append(one)}
    done = compare(study / "measured", models, **only, **given(study))
    assert [a.model for a in done.comparison.ranking.areas] == ["right", "half"]
    assert told[0][0] == "note"
    assert [part for part in told[1:] if part[0] == "note"] == []
    assert [part[1:] for part in told[1:]] == [
        (what, share) for what in ("reading", "comparing", "writing") for share in (0.0, 1.0)
    ]
    assert "No label is named like a bone: fat, skin are compared as soft tissue." in told[0][1]
    (said,) = [note for note in done.comparison.notes if "no bone" in note]
    assert "all of its labels (fat, skin) are compared as soft tissue" in said
    # the error is known by distance to bone; without one it would be taken for that of tissue far away
    assert np.isnan(done.comparison.ranking.areas[0].low_ml)
    page = re.sub(r"\s+", " ", (study / "out" / "report.html").read_text())
    assert "Agreement by distance to bone" not in page
    assert "lowest point" not in page
    assert "The slice goes through the middle of the mesh." in page
    parts = {r["part"] for r in rows(study / "out" / "agreement.csv")}
    assert not any("bone" in part for part in parts)
    assert not any("bone" in part for part in meshio.read(study / "out" / "Load1" / "fields.vtu").cell_data)


def test_every_label_that_is_named_like_a_bone_is_one(study: Path) -> None:
    (study / "tissues.csv").write_text("label,name\n1,fat\n2,skin\n3,Calcaneus\n")
    done = compare(study / "measured", [study / "right"], loads=["Load1"], **given(study))
    assert done.comparison.loads[0].bones == ("Calcaneus",)


def test_bone_that_is_only_not_named_is_not_compared_as_soft_tissue(study: Path) -> None:
    (study / "tissues.csv").write_text("label,name\n1,fat\n2,label-2\n3,upper\n")
    with pytest.raises(InputError, match=r"no label 'bone'; its labels are .* Name its bones \(bones, --bone\)"):
        compare(study / "measured", [study / "right"], **given(study))
