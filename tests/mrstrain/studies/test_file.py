"""The study file: what is read from it, and everything that is refused, at once and with the nearest known key."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from dvc.errors import InputError
from mrstrain.studies.file import _fields_at, read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.plan import plan

WHOLE = """
[study]
name = "Heel"
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
[loads.Load1]
image = "Load1.nii.gz"
normal_n = 140
[loads.Load2]
image = "Load2.nii.gz"
normal_n = 15.0
shear_n = 45.0
[models]
sets = ["trebbi", "luboz"]
results = ["ansys"]
"""


def written(folder: Path, text: str) -> Path:
    (folder / "study.toml").write_text(text)
    return folder


def test_values_and_paths_start_from_the_file(tmp_path):
    study = read_study(written(tmp_path, WHOLE))
    assert study.loads["Load1"].normal_n == 140.0
    assert study.path(study.images.load0) == tmp_path / "Load0.nii.gz"
    assert study.out == tmp_path / "results"
    assert study.plate.plate_normal == (0.0, 0.0, -1.0)
    assert read_study(tmp_path / "study.toml") == study


def test_everything_wrong_is_told_at_once_with_the_nearest_key(tmp_path):
    text = WHOLE.replace("normal_n = 140", "norml_n = 140").replace('name = "Heel"', 'nam = "Heel"')
    text = text.replace("shear_n = 45.0", 'shear_n = "45"') + "[mesh]\nedge = 2.0\n[meshing]\n"
    with pytest.raises(InputError) as told:
        read_study(written(tmp_path, text))
    for sentence in (
        "[study] 'name' is missing",
        "[study] 'nam' is an unknown key; did you mean 'name'?",
        "[loads.Load1] 'norml_n' is an unknown key; did you mean 'normal_n'?",
        "[loads.Load2] 'shear_n'",
        "[mesh] 'edge' is an unknown key; did you mean 'edge_mm'?",
        "'meshing' is an unknown key; did you mean 'mesh'?",
    ):
        assert sentence in str(told.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("normal_n = 140", "normal_n = true", "normal_n"),
        ("normal_n = 140", "normal_n = -5.0", "greater than 0"),
        ("normal_n = 140", "normal_n = nan", "normal_n"),
        ("[loads.Load1]", '[loads."../Load1"]', "folder"),
        ("[loads.Load1]", '[loads."repeat"]', "repeat scan"),
        ('sets = ["trebbi", "luboz"]', 'sets = ["trebbi", "trebbi"]', "only once"),
        ('name = "Heel"', 'name = "Heel"\nout = "../elsewhere"', "is not below the folder of the study"),
        ('name = "Heel"', 'name = "Heel"\nout = "/tmp/elsewhere"', "is not below the folder of the study"),
        ('name = "Heel"', 'name = "Heel"\nout = "."', "is not below the folder of the study"),
        ('name = "Heel"', 'name = "Heel"\nseed = 0', "seed"),
        ("tissues.nii.gz", "tissues\\u0000.nii.gz", r"labels has a null character \(\\u0000\)"),
        ("tissues.nii.gz", "auto", "needs 'bone_mask', the mask of the bone, or 'marks'"),
        ('"tissues.nii.gz"', '"auto"\nmarks = "m.nii.gz"\nnames = "n.csv"', "'names' is not for labels"),
        ('"tissues.nii.gz"', '"auto"\nmarks = "m.nii.gz"\nallow_missing = true', "without missing voxels"),
        ('"tissues.nii.gz"', '"tissues.nii.gz"\nmarks = "m.nii.gz"', "only for labels"),
        ('"tissues.nii.gz"', '"tissues.nii.gz"\ncorrect_labels = true\nallow_missing = true', "without missing voxels"),
        ("[study]", "[study", "not valid TOML"),
        ("[study]", 'place = "/tmp"\n[study]', "unknown key 'place'"),
    ],
)
def test_refused(tmp_path, old, new, words):
    assert old in WHOLE
    with pytest.raises(InputError, match=words):
        read_study(written(tmp_path, WHOLE.replace(old, new)))


def test_every_line_that_is_no_toml_is_told_and_what_is_wrong_stands_by_line(tmp_path):
    text = WHOLE.replace("normal_n = 140", "normal_n =").replace("normal_n = 15.0", "normal_n = ...")
    with pytest.raises(
        InputError, match=r"(?s)not valid TOML:\n  line 9: .*normal_n =\n  line 12: .*normal_n = \.\.\."
    ):
        read_study(written(tmp_path, text))
    text = WHOLE.replace('load0 = "', '# load0 = "').replace("shear_n = 45.0", 'shear_n = "45"')
    text = text.replace('[study]\nname = "Heel"\n', "")
    with pytest.raises(InputError) as told:
        read_study(written(tmp_path, text))
    places = [line.split("]")[0].strip() for line in str(told.value).splitlines()[1:]]
    assert places == ["'study' is missing.", "line 3: [images", "line 11: [loads.Load2"]


def test_no_file(tmp_path):
    with pytest.raises(InputError, match="mrstrain init"):
        read_study(tmp_path)


def test_the_plan_names_every_stage_behind_what_it_waits_for(tmp_path):
    text = WHOLE.replace('labels = "', 'repeat = "again.nii.gz"\nlabels = "') + "level = true\ndrive = true\n"
    stages = plan(read_study(written(tmp_path, text)))
    names = [stage.name for stage in stages]
    assert names == [
        "register repeat", "register Load1", "register Load2", "mesh",
        "simulate trebbi", "drive trebbi", "level trebbi Load1", "level trebbi Load2",
        "simulate luboz", "drive luboz", "level luboz Load1", "level luboz Load2", "compare",
    ]  # fmt: skip
    for at, stage in enumerate(stages):
        assert set(stage.before) <= set(names[:at])
    by_name = dict(zip(names, stages, strict=True))
    assert by_name["register Load2"].before == ("register repeat",)
    assert by_name["level trebbi Load1"].before == ("simulate trebbi",)
    assert tmp_path / "ansys" in by_name["compare"].files


def test_labels_from_the_image_come_before_all_that_reads_them(tmp_path):
    text = WHOLE.replace('"tissues.nii.gz"', '"auto"\nbone_mask = "bone.nii.gz"') + "level = true\n"
    study = read_study(written(tmp_path, text))
    stages = {stage.name: stage for stage in plan(study)}
    made = tmp_path / "results" / "labels" / "tissues.nii.gz"
    assert next(iter(stages)) == "label"
    assert stages["label"].gives == (made.parent,)
    assert [path.name for path in stages["label"].files] == ["Load0.nii.gz", "bone.nii.gz"]
    readers = ["register Load1", "mesh", "level trebbi Load1", "compare"]
    for name in readers:
        assert "label" in stages[name].after, name
        assert stages[name].arguments["labels"] == made, name
        assert made not in stages[name].files, name
    registered = stages["register Load1"].arguments
    assert (registered["bone"], registered["bone_label"]) == (None, "bone")  # of the label map, not the mask
    other = read_study(written(tmp_path, text + '[mesh]\nlabels = "cut.nii.gz"\n'))
    assert {stage.name: stage for stage in plan(other)}["mesh"].after == ()


def test_a_label_map_that_was_drawn_is_corrected_first(tmp_path):
    text = WHOLE.replace('"tissues.nii.gz"', '"tissues.nii.gz"\ncorrect_labels = true\nnames = "tissues.csv"')
    stages = {stage.name: stage for stage in plan(read_study(written(tmp_path, text)))}
    given = {"labels": tmp_path / "tissues.nii.gz", "names": tmp_path / "tissues.csv"}
    assert given.items() <= stages["label"].arguments.items()
    assert [path.name for path in stages["label"].files] == ["Load0.nii.gz", "tissues.nii.gz", "tissues.csv"]
    for name in ("register Load1", "mesh", "compare"):
        assert stages[name].arguments["labels"] == tmp_path / "results" / "labels" / "tissues.nii.gz", name
        assert "label" in stages[name].after, name
    with pytest.raises(InputError, match="for a label map that was drawn"):
        read_study(written(tmp_path, text.replace('"tissues.nii.gz"', '"auto"')))


def test_chained_loads_wait_for_one_another(tmp_path):
    stages = plan(read_study(written(tmp_path, WHOLE + "[registration]\nchain = true\n")))
    assert next(s for s in stages if s.name == "register Load2").before == ("register Load1",)


def test_a_simulated_load_needs_its_force(tmp_path):
    text = WHOLE.replace("normal_n = 15.0\n", "")
    with pytest.raises(
        InputError,
        match=r"(?s)Shear needs a normal force or plate displacement as well.*\n  line 10: \[loads.Load2\] 'normal_n'",
    ):
        plan(read_study(written(tmp_path, text)))
    alone = text.replace("shear_n = 45.0\n", "") + "level = true\n"
    stages = {stage.name: stage for stage in plan(read_study(written(tmp_path, alone)))}
    assert [load["name"] for load in stages["simulate trebbi"].arguments["loads"]] == ["Load1"]
    assert {name for name in stages if name.startswith("level trebbi")} == {"level trebbi Load1"}
    assert "register Load2" in stages  # measured all the same
    with pytest.raises(
        InputError,
        match=r"(?s)No load has a normal force or plate displacement.*line 7: \[loads.Load1\].*line 9: \[loads.Load2\]",
    ):
        plan(read_study(written(tmp_path, alone.replace("normal_n = 140\n", ""))))
    measured = text.replace('sets = ["trebbi", "luboz"]', "sets = []")
    assert [s.kind for s in plan(read_study(written(tmp_path, measured)))] == ["register", "register", "compare"]


def test_a_load_has_the_plates_directions_or_its_own(tmp_path):
    text = WHOLE.replace("shear_n = 45.0", "shear_n = 45.0\nshear_direction = [1.0, 0.0, 0.0]")
    (found,) = (s for s in plan(read_study(written(tmp_path, text))) if s.name == "simulate trebbi")
    usual = ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0))
    assert found.arguments["towards"] == {"Load1": usual, "Load2": (usual[0], (1.0, 0.0, 0.0))}
    measured = {s.name: s.arguments["shear_direction"] for s in plan(read_study(tmp_path)) if s.kind == "register"}
    assert measured == {"register Load1": (0.0, -1.0, 0.0), "register Load2": (1.0, 0.0, 0.0)}
    (found,) = (s for s in plan(read_study(written(tmp_path, WHOLE))) if s.name == "simulate trebbi")
    assert found.arguments["towards"] == {"Load1": usual, "Load2": usual}


def test_weights_of_the_engine_and_the_plates_pivot_reach_their_stages(tmp_path):
    text = WHOLE + "[registration]\nvolume = 3.0\n[plate]\npivot_mm = [1.0, 2.0, 3.0]\n"
    stages = {stage.name: stage.arguments for stage in plan(read_study(written(tmp_path, text)))}
    assert stages["register Load1"]["volume"] == 3.0
    assert stages["register Load1"]["bending"] is None
    assert stages["simulate trebbi"]["pivot_mm"] == (1.0, 2.0, 3.0)


def test_a_simulation_may_have_a_limit_of_time(tmp_path):
    for text, limit in ((WHOLE + "limit_minutes = 2.5\n", 150.0), (WHOLE, None)):
        (simulated,) = (s for s in plan(read_study(written(tmp_path, text))) if s.name == "simulate trebbi")
        assert simulated.arguments["limit_s"] == limit


def test_the_page_on_studies_names_every_key_and_no_other():
    page = (Path(__file__).parents[3] / "docs" / "reference" / "study-file.md").read_text(encoding="utf-8")
    sections = re.findall(r"^## `\[(\w+)(?:\.NAME)?\]`\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    assert {table for table, _ in sections} == set(_fields_at([]))
    for table, section in sections:
        named = [key for cell in re.findall(r"^\| (`.*?) \| \S", section, re.MULTILINE) for key in cell.split(", ")]
        known = _fields_at([table, "NAME"] if table == "loads" else [table])
        assert sorted(named) == sorted(f"`{key}`" for key in known), table


def test_two_models_of_one_name_are_refused(tmp_path):
    with pytest.raises(InputError, match="rename the folder"):
        plan(read_study(written(tmp_path, WHOLE.replace('["ansys"]', '["other/trebbi"]'))))


def test_a_set_whose_name_is_no_folder_is_refused(tmp_path):
    (tmp_path / "mine.toml").write_text(
        '["../.."]\ntitle = "x"\nsource = "x"\n["../..".all]\nlaw = "neo-Hooke"\nmu_kpa = 10.0\nnu = 0.49\n'
    )
    with pytest.raises(InputError, match="folder"):
        plan(read_study(written(tmp_path, WHOLE.replace('"luboz"', '"mine.toml"'))))


@pytest.mark.parametrize("link", ["registration", "registration/Load1", "models/luboz", "comparison"])
def test_results_that_a_link_would_take_elsewhere_are_refused(tmp_path, link):
    elsewhere, study = tmp_path / "elsewhere", tmp_path / "study"
    elsewhere.mkdir()
    place = study / "results" / link
    place.parent.mkdir(parents=True)
    place.symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(InputError, match=r"would write to .*elsewhere.*, which is not below the results folder"):
        plan(read_study(written(study, WHOLE)))
    place.unlink()
    assert plan(read_study(study))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"tissues.nii.gz"', '"results/tissues.nii.gz"'),
        ('results = ["ansys"]', 'results = ["results/models/ansys"]'),
        ('name = "Heel"', 'name = "Heel"\nout = "ansys/here"'),
    ],
)
def test_inputs_and_results_do_not_lie_in_one_another(tmp_path, old, new):
    assert old in WHOLE
    with pytest.raises(InputError, match="is an input, and results in"):
        plan(read_study(written(tmp_path, WHOLE.replace(old, new))))


def test_a_model_is_levelled_by_the_preset_that_measured(tmp_path):
    text = WHOLE + 'level = true\n[registration]\nparameters = ["mine.txt"]\n'
    (stage,) = (s for s in plan(read_study(written(tmp_path, text))) if s.name == "level trebbi Load1")
    assert stage.arguments["parameters"] == (tmp_path / "mine.txt",)
    assert tmp_path / "mine.txt" in stage.files


def test_borders_are_asked_of_measurement_and_levelling_and_their_results_are_others(tmp_path):
    text = WHOLE + "level = true\n[registration]\n"
    keys: dict[str, list[str]] = {}
    for borders in ("false", "true"):
        for stage in plan(read_study(written(tmp_path, text + f"borders = {borders}\n"))):
            if stage.kind in {"register", "level"}:
                assert stage.arguments["borders"] is (borders == "true")
                alone = replace(stage, files=())
                ledger = Ledger(tmp_path / "results", tmp_path)
                key = ledger.key(alone, ledger.made_from(alone, stage.arguments), {})
                keys.setdefault(stage.name, []).append(key)
    assert len(keys) > 2
    assert all(plain != with_borders for plain, with_borders in keys.values())


def test_files_that_inputs_name_are_inputs_too(tmp_path):
    (tmp_path / "ansys").mkdir()
    (tmp_path / "heel.cdb").write_text("x")
    (tmp_path / "ansys" / "model.toml").write_text('mesh = "../heel.cdb"\n')
    (tmp_path / "own.vtu").write_text("x")
    (tmp_path / "own.json").write_text("{}")
    stages = plan(read_study(written(tmp_path, WHOLE + '[mesh]\nfile = "own.vtu"\n')))
    files = {stage.name: [path.resolve() for path in stage.files] for stage in stages}
    assert tmp_path / "heel.cdb" in files["compare"]
    assert tmp_path / "own.json" in files["simulate trebbi"]


def test_unit_and_frame_are_those_of_a_mesh_made_elsewhere(tmp_path):
    (tmp_path / "own.vtu").write_text("x")
    of_file = WHOLE + '[mesh]\nfile = "own.vtu"\nunit = "m"\nframe = "RAS"\n'
    simulated = [stage for stage in plan(read_study(written(tmp_path, of_file))) if stage.kind == "simulate"]
    assert {(stage.arguments["mesh_unit"], stage.arguments["mesh_frame"]) for stage in simulated} == {("m", "RAS")}
    for key in ('unit = "m"', 'frame = "RAS"'):
        with pytest.raises(InputError, match="which 'file' must name"):
            read_study(written(tmp_path, WHOLE + f"[mesh]\n{key}\n"))
