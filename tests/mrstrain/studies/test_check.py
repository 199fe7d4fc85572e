"""`check`: problems that would stop a later stage are reported before a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.errors import InputError, RegistrationError
from dvc.images.image import Grid, Image, LabelMap
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_labels
from dvc.mesh import TetMesh
from fe import write_tet_mesh
from mrstrain.cli.app import app
from mrstrain.options.credibility import CredibilityOptions
from mrstrain.studies import stages
from mrstrain.studies.check import check, wrong_with
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import plan
from mrstrain.studies.run import forecast, run
from tests.fe.test_simulate import dome
from tests.mrstrain.comparison.test_model_files import model
from tests.mrstrain.studies.checked_study import GRID, STUDY, wrong


def test_a_tissue_without_a_law_is_told_and_one_that_takes_anothers_is_not(study):
    # tendon takes fat's; the table names a skin that no voxel has, so no cell will need its law
    assert wrong(study) == ""
    values = np.full(GRID.shape, 9)
    values[:8], values[:4] = 1, 2
    write_labels(study / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "bone", 9: "skin"}))
    assert wrong(study).startswith("The material set mine has no material for the region 'skin'")
    assert wrong(study, ('"mine.toml", ', "")) == ""


def test_odd_materials_forces_and_gaps_are_told_before_a_run(study):
    (study / "stiff.toml").write_text('[stiff]\ntitle = "kPa typed as MPa"\n[stiff.fat]\nlaw = "neo-Hooke"\n'
                                      "mu_mpa = 10.0\nnu = 0.49\n")  # fmt: skip
    text = (study / "study.toml").read_text()
    changed = text.replace('"mine.toml"', '"stiff.toml"').replace("normal_n = 15.0", "normal_n = 1e9", 1)
    assert changed != text
    (study / "study.toml").write_text(changed)
    warnings = check(study).warnings
    assert any("stiff: " in note and "fat" in note and "kPa" in note for note in warnings), warnings
    assert any("a force of 1e+09 N is several times the weight of a person" in note for note in warnings), warnings
    (study / "study.toml").write_text(text)
    assert not any("several times" in warning for warning in check(study).warnings)
    assert "gap_mm (--gap-mm), is 1e+06 mm, larger" in wrong(study, ("[plate]", "[plate]\ngap_mm = 1e6"))


def test_the_command_ends_with_status_2_where_something_is_wrong_and_0_where_nothing_is(study):
    text = (study / "study.toml").read_text().replace('"mine.toml", ', "")
    (study / "study.toml").write_text(text)
    well = CliRunner().invoke(app, ["check", str(study)])
    assert (well.exit_code, "ERROR" in well.output) == (0, False), well.output
    (study / "Load1.nii.gz").unlink()
    ill = CliRunner().invoke(app, ["check", str(study)])
    assert ill.exit_code == 2
    assert "ERROR" in ill.output


def test_the_next_step_takes_a_folder_with_a_space(study):
    (study / "study.toml").write_text(STUDY.replace('"mine.toml", ', ""))
    spaced = study.rename(study.parent / "study one")
    assert check(spaced).summary()[-1] == f"No problems found. Next step: mrstrain run '{spaced}'"


def test_details_that_nobody_must_give_are_one_note_and_no_problem(study):
    def told(more: str) -> list[str]:
        (study / "study.toml").write_text(STUDY.replace('"mine.toml", ', "") + more)
        done = check(study)
        assert not done.wrong
        assert done.summary()[-1] == f"No problems found. Next step: mrstrain run {study}"
        return [note for note in done.notes if "[acquisition]" in note or "[credibility]" in note]

    optional = "Optional details of the report that are not given: "
    where = "A study file written by `mrstrain init` lists the keys."
    assert told("") == [f"{optional}12 of 12 in [acquisition], 26 of 26 in [credibility]. {where}"]
    (study / "Load0.json").write_text('{"FlipAngle": 12}')  # of dcm2niix
    more = '[acquisition]\nsnr = 20.0\n[credibility]\nquestion_of_interest = "Which?"\nlevel_use_error = "b"\n'
    assert told(more) == [f"{optional}10 of 12 in [acquisition], 24 of 26 in [credibility]. {where}"]
    chosen = {"model_influence": "low", "decision_consequence": "low", "model_risk": "low"}
    words = {name: chosen.get(name, "some") for name in CredibilityOptions.model_fields}
    said = "[credibility]\n" + "".join(f'{name} = "{text}"\n' for name, text in words.items())
    assert told(said) == [f"{optional}11 of 12 in [acquisition]. {where}"]
    (study / "Load1.nii.gz").unlink()
    ill = check(study)
    assert ill.wrong  # is all that is told
    assert not any(note.startswith("Optional") for note in ill.notes)
    assert ill.summary()[-1].startswith("ERROR: ")
    assert not any("No problems found" in line for line in ill.summary())


def test_a_plate_that_nobody_placed_is_said_to_be_inferior(study):
    def told(*changes: tuple[str, str]) -> list[str]:
        assert wrong(study, ('"mine.toml", ', ""), *changes) == ""
        return [note for note in check(study).notes if "plate" in note]

    normal = "normal = [-1.0, 0.0, 0.0]\n"
    inferior = [
        "The plate is taken to be inferior to the body (normal 0 0 -1, LPS). If it lies elsewhere, change normal in "
        "[plate] of the study file."
    ]
    assert told() == []
    assert told((normal, "")) == inferior
    assert told((normal, "normal = [0.0, 0.0, -1.0]\n")) == inferior  # as `init` writes it for everyone
    own = "shear_n = 4.0\nplate_normal = [-1.0, 0.0, 0.0]\n"
    assert told((normal, ""), ("shear_n = 4.0\n", own)) == []


def test_warnings_are_counted_where_no_problem_is_found(study):
    values = np.ones(GRID.shape, dtype=np.int64)
    values[:4], values[4:6] = 2, 3
    write_labels(study / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "bone", 3: "talus"}))
    whole = ('"mine.toml", "friedman"', '"akrami"')  # which has one material for all tissues
    assert wrong(study, ("[mesh]", '[mesh]\nbones = ["bone"]'), whole) == ""
    assert check(study).summary()[-1].startswith("No problems found, but 1 warning above. Next step: mrstrain run ")


def test_images_on_one_grid_stand_in_one_line_and_another_grid_is_seen(study):
    def told() -> list[str]:
        return [note for note in check(study).notes if "voxels of" in note]

    box = "x -7.0 to 25.0, y -7.0 to 25.0, z -7.0 to 25.0 mm (LPS)"
    assert told() == [f"Load0, Load1: 16 x 16 x 16 voxels of 2 x 2 x 2 mm; {box}"]
    moved = replace(GRID, origin_mm=GRID.origin_mm + 1.0)
    write_image(study / "Load1.nii.gz", Image(moved, read_image(study / "Load1.nii.gz").values))
    assert [note.partition(": ")[0] for note in told()] == ["Load0", "Load1"]


def test_a_bone_that_would_be_meshed_as_tissue_is_told(study):
    def told() -> list[str]:
        return [warning for warning in check(study).warnings if warning.startswith("talus")]

    assert told() == []
    values = np.ones(GRID.shape, dtype=np.int64)
    values[:4], values[4:6] = 2, 3
    write_labels(study / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "bone", 3: "talus"}))
    assert told() == []  # every label that is named like a bone is one
    (study / "study.toml").write_text(STUDY.replace("[mesh]", '[mesh]\nbones = ["bone"]'))
    assert told() == [
        "talus will be meshed as soft tissue, but has the name of a bone. If it is one, add it to [mesh] bones."
    ]


def test_labels_that_are_made_later_are_checked_by_what_they_are_made_from(study):
    auto = ('labels = "tissues.nii.gz"\nnames = "tissues.csv"', 'labels = "auto"\nmarks = "strokes.nii.gz"')
    values = np.zeros(GRID.shape, dtype=np.int64)
    values[1, 1, 1], values[8, 3, 3] = 1, 2
    write_labels(study / "strokes.nii.gz", LabelMap(GRID, values, {1: "calcaneus", 2: "fat"}))
    (study / "strokes.csv").write_text("label,name\n1,calcaneus\n2,fat\n")
    named = (auto[0], auto[1] + '\nmark_names = "strokes.csv"')
    assert "has no region 'bone'; it has calcaneus, fat" in wrong(study, named)
    named = (auto[0], named[1] + '\nbone = "calcaneus"')
    assert "no material for the region 'skin'" in wrong(study, named)  # mine.toml has a law for fat alone
    assert wrong(study, named, ('"mine.toml", ', "")) == ""
    assert "Labels: made from the image" in check(study).notes
    assert "other bone" not in " ".join(check(study).warnings)
    bones = ("[mesh]", '[mesh]\nbones = ["bone"]')
    assert wrong(study, named, ('"mine.toml", ', ""), bones) == ""  # the image may show no other bone
    if_there = "other bone, if the label map that is made has it, will be meshed as soft tissue"
    assert any(warning.startswith(if_there) for warning in check(study).warnings)
    elsewhere = LabelMap(replace(GRID, origin_mm=GRID.origin_mm + 500.0), values, {1: "calcaneus", 2: "fat"})
    write_labels(study / "strokes.nii.gz", elsewhere)
    assert "strokes.nii.gz" in wrong(study, named, ('"mine.toml", ', ""))


def test_a_label_map_called_nearly_as_auto_is_asked_about_once_as_on_the_command_line(study):
    misspelt = ('labels = "tissues.nii.gz"\nnames = "tissues.csv"', 'labels = "autp"')
    told = wrong(study, misspelt)
    assert told.count("autp") == 1
    assert "autp: no such file or folder. Did you mean auto? Check the spelling." in told
    with pytest.raises(InputError, match="Did you mean auto"):
        run(study)
    with pytest.raises(InputError, match=r"only for labels = \"auto\" \(did you mean that by 'autp'\?\)"):
        wrong(study, (misspelt[0], 'labels = "autp"\nmarks = "tissues.nii.gz"'))
    wrong(study, (misspelt[0], 'labels = "auto"\nbone_mask = "gone.nii.gz"'))
    with pytest.raises(InputError, match=r"do not exist:\n  \S+gone.nii.gz$"):
        run(study)
    (study / "autp").touch()
    assert "Did you mean" not in wrong(study, misspelt)


def test_labels_without_a_boundary_to_correct_are_told(study):
    asked = ('names = "tissues.csv"', 'names = "tissues.csv"\ncorrect_labels = true')
    assert wrong(study, asked, ('"mine.toml", ', "")) == ""
    told = [warning for warning in check(study).warnings if "correct_labels" in warning]
    assert told == ["no label is named skin, so correct_labels corrects only bones."]
    values = np.ones(GRID.shape, dtype=np.int64)
    values[:4] = 2
    write_labels(study / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "heel"}))
    assert "line 8: [images] 'correct_labels': No label is named skin, or like a bone" in wrong(study, asked)
    values[:2] = 3
    write_labels(study / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "heel", 3: "skin"}))
    assert "correct_labels" not in wrong(study, asked)
    assert "no label is named like a bone, so correct_labels" in "\n".join(check(study).warnings)


def test_a_plate_without_friction_carries_no_shear(study):
    write_tet_mesh(study / "dome.vtu", dome((3, 4, 4)), {})
    for mesh in ("[mesh]", '[mesh]\nfile = "dome.vtu"'):
        told = wrong(
            study, ("[registration]", "taped = false\n[registration]"), ("[mesh]", mesh), ('"mine.toml", ', "")
        )
        assert told.startswith("Load1: a plate without friction cannot apply shear")
        assert told.count("\n") == 0


def test_directions_of_one_load_are_looked_at_like_those_of_the_plate(study):
    of_load = ("shear_n = 4.0", "shear_n = 4.0\nshear_direction = [2.0, 0.0, 0.0]")
    assert "shear" in wrong(study, of_load)
    assert wrong(study, (of_load[0], of_load[1].replace("2.0, 0.0, 0.0", "0.0, 2.0, 0.0"))) == ""


def test_a_label_map_to_mesh_that_lies_elsewhere_and_one_image_for_two_loads_are_told(study):
    far = Grid(GRID.shape, GRID.spacing_mm, GRID.origin_mm + np.array([500.0, 0.0, 0.0]))
    values = np.ones(GRID.shape, dtype=np.int64)
    values[:4] = 2
    write_labels(study / "far.nii.gz", LabelMap(far, values, {1: "fat", 2: "bone"}))
    there = ("[mesh]", '[mesh]\nlabels = "far.nii.gz"\nnames = "tissues.csv"')
    assert "only 0 % of the labelled tissue lies in the unloaded image" in wrong(study, there)
    twice = ("[plate]", '[loads.Load2]\nimage = "Load1.nii.gz"\nnormal_n = 2.0\n[plate]')
    assert wrong(study, twice) == "Load2 is identical to the image of Load1 (all voxels are equal)."
    forceless = (twice[0], twice[1].replace("normal_n = 2.0\n", ""))
    wrong(study, forceless)
    place = "line 12: [loads.Load2] 'normal_n'"
    assert f"Load2: measured but not simulated, because no force is given ({place})." in check(study).notes


def test_a_mesh_made_elsewhere_is_asked_as_simulate_asks(study):
    made = dome((3, 4, 4))
    file, friedman = ("[mesh]", '[mesh]\nfile = "dome.vtu"'), ('"mine.toml", ', "")
    write_tet_mesh(study / "dome.vtu", made, {})
    assert wrong(study, file, friedman) == ""
    assert "mine has no material for the region 'skin'" in wrong(study, file)
    assert "no surface set 'cut'" in wrong(study, file, friedman, ("sets", 'fixed = ["bone", "cut"]\nsets'))
    assert wrong(study, file, friedman, ("sets", 'fixed = ["Bone"]\nsets')) == ""  # case does not count
    assert "All nodes of 'skin' are fixed" in wrong(study, file, friedman, ("sets", 'fixed = ["skin"]\nsets'))
    far = TetMesh(made.points_mm + 400.0, made.cells, made.regions, made.facets)
    write_tet_mesh(study / "dome.vtu", far, {})
    assert "dome.vtu does not lie in the image" in wrong(study, file, friedman)


def test_without_a_bone_the_whole_image_is_aligned_on_and_models_are_refused(study, monkeypatch):
    tissues = LabelMap(GRID, np.ones(GRID.shape, dtype=np.int64), {1: "fat"})
    write_labels(study / "tissues.nii.gz", tissues)
    align, measured = ("[registration]", '[registration]\nalign = "image"'), ('"mine.toml", "friedman"', "")
    assert wrong(study, measured).startswith("line 4: [images] 'bone': The label map has no region 'bone'")
    assert "line 16: [mesh] 'bones': The label map has no region 'bone'" in wrong(study, align)  # a mesh needs one
    assert "no region 'sacrum'" in wrong(study, align, measured, ("labels =", 'bone = "sacrum"\nlabels ='))
    assert wrong(study, align, measured) == ""
    (stage,) = plan(read_study(study))
    asked = {}

    def never(reference, loaded, *, bone, settings, **_):
        asked.update(bone=bone, on=settings.align_on)
        raise RegistrationError("enough")

    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", never)
    body = np.zeros(GRID.shape, dtype=bool)
    body[2:-2, 2:-2, 2:-2] = True
    monkeypatch.setattr("dvc.measurement.subject.tissue_mask", lambda _: body)
    with pytest.raises(RegistrationError, match="enough"):
        stages.register(lambda *_: None, **stage.arguments, repeat=[])
    assert asked == {"bone": None, "on": "image"}
    (study / "study.toml").write_text(
        STUDY.replace(*align).replace('sets = ["mine.toml", "friedman"]', 'sets = ["friedman"]\nlevel = true')
    )
    with pytest.raises(InputError, match="level = true needs a rigid bone"):
        plan(read_study(study))


def test_what_is_fixed_beside_the_bone_has_to_be_there_and_decides_what_is_done_anew(study):
    friedman = ('"mine.toml", ', "")
    assert "only 'cut' can be fixed in addition to the bone" in wrong(
        study, friedman, ("sets", 'fixed = ["skin"]\nsets')
    )
    assert "if a tissue of the label map is named skin" in wrong(study, friedman, ("sets", 'fixed = ["Cut"]\nsets'))

    def held(fixed: str) -> object:
        wrong(study, friedman, ("sets", f"{fixed}sets"))
        return next(stage.arguments["fixed"] for stage in plan(read_study(study)) if stage.kind == "simulate")

    assert held("") == held('fixed = ["bone"]\n') == ("bone",)
    assert held('fixed = ["cut"]\n') == ("bone", "cut")


def test_a_run_refuses_before_it_begins_what_all_of_it_needs(study, monkeypatch):
    def never(*_, **__):
        raise AssertionError("a cluster was started")

    monkeypatch.setattr("mrstrain.studies.cluster.cluster", never)
    for change, told in (
        (("labels =", 'bone = "calcaneuz"\nlabels ='), "no region 'calcaneuz'"),
        (("[mesh]", "[mesh]\nedge_mm = 0.02"), "half a voxel"),
        (("[mesh]", '[mesh]\nfiner = { region = "skni", edge_mm = 1.0 }'), "no region 'skni'"),
        (("sets =", 'fixed = ["skin"]\nsets ='), "only 'cut' can be fixed"),
    ):
        assert told in wrong(study, change)
        for begin in (run, forecast):
            with pytest.raises(InputError, match=f"(?s)cannot be run.*Heel: .*{told}"):
                begin(study)
        if "bone =" not in change[1]:
            assert forecast(study, only=("register",))["register Load1"] == "will run"
    assert not (study / "results").exists()
    (study / "study.toml").write_text(STUDY.replace("labels =", 'bone = "calcaneuz"\nlabels ='))
    assert forecast(study, only=("mesh", "simulate"))["simulate friedman"] == "will run"


def test_stages_are_refused_by_what_they_need_and_not_by_what_others_do(study):
    def refused(*only: str) -> str:
        try:
            what = forecast(study, only=only)
        except InputError as wrong:
            return str(wrong)
        assert "will run" in what.values()
        return ""

    values = np.full(GRID.shape, 9)
    values[:8], values[:4] = 1, 2
    write_labels(study / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "bone", 9: "skin"}))
    assert "mine has no material for the region 'skin'" in refused("mesh", "simulate mine")
    assert refused("mesh") == refused("register") == refused("mesh", "simulate friedman") == ""
    second = STUDY.replace(
        "[plate]", '[loads.Load2]\nimage = "Load1.nii.gz"\nnormal_n = 2.0\nshear_direction = [2.0, 0.0, 0.0]\n[plate]'
    )
    (study / "study.toml").write_text(second)
    assert refused("register Load1") == refused("mesh") == ""
    assert "shear" in refused("register Load2")
    (study / "study.toml").write_text(STUDY.replace("[registration]", "taped = false\n[registration]"))
    assert "a plate without friction" in refused("mesh", "simulate friedman")
    assert refused("mesh") == ""


@pytest.mark.parametrize("name", ["Load0", "tissues"])
def test_an_image_that_all_registrations_read_is_refused_where_it_is_damaged(study, name):
    file = study / f"{name}.nii.gz"
    file.write_bytes(file.read_bytes()[:-99])
    with pytest.raises(InputError, match=f"(?s)cannot be run.*{name}"):
        forecast(study, only=("register",))
    if name == "Load0":
        assert forecast(study, only=("mesh",))["mesh"] == "will run"


def test_what_is_meshed_is_looked_at_as_it_is(study):
    """Labels in voxels of 1 mm are meshed at .6 mm; brought to the image's 2 mm for all else."""
    fine = Grid((32, 32, 32), (1.0, 1.0, 1.0), (-6.5, -6.5, -6.5))
    values = np.ones(fine.shape, dtype=np.int64)
    values[:8] = 2
    write_labels(study / "tissues.nii.gz", LabelMap(fine, values, {1: "fat", 2: "bone"}))
    assert wrong(study, ("[mesh]", "[mesh]\nedge_mm = 0.6")) == ""
    assert "half a voxel" in wrong(study, ("[mesh]", "[mesh]\nedge_mm = 0.4"))


def test_a_damaged_loaded_image_is_left_to_its_stage(study):
    (study / "Load1.nii.gz").write_bytes((study / "Load1.nii.gz").read_bytes()[:-99])
    assert "Load1.nii.gz" in "".join(check(study).wrong)
    told = read_study(study)
    assert wrong_with(told, plan(told)) == ()


@pytest.mark.parametrize(("given", "told"), [("[0.5, 0.2]", "must increase"), ("[20.0, 50.0]", "not in percent")])
def test_a_range_of_strain_that_no_comparison_takes_is_refused_with_the_study_file(study, given, told):
    (study / "study.toml").write_text(STUDY + f"[compare]\nstrains = {given}\n")
    with pytest.raises(InputError, match=rf"\[compare\] 'strains': .*{told}"):
        read_study(study)


def test_gaps_are_left_out_where_the_study_says_so(study):
    image = read_image(study / "Load1.nii.gz")
    values = image.values.copy()
    values[3, 3, 3] = np.nan
    write_image(study / "Load1.nii.gz", Image(GRID, values))
    assert "1 of 4096 voxels are NaN" in wrong(study)
    masked = ("labels =", "allow_missing = true\nlabels =")
    assert wrong(study, masked) == ""
    (registered, *_) = plan(read_study(study))
    assert registered.arguments["allow_missing"]
    level = ("[models]", "[models]\nlevel = true")
    assert wrong(study, masked, level) == ""  # which reads the unloaded image alone
    write_image(study / "Load0.nii.gz", Image(GRID, values[::-1]))
    assert "level = true needs an unloaded image without" in wrong(study, masked, level)
    with pytest.raises(InputError, match="level = true"):
        forecast(study)
    assert forecast(study, only=("register",))["register Load1"] == "will run"


def test_a_run_of_another_code_that_ended_early_is_told_and_may_be_asked_for(study):
    model(study / "febio", Load1="febio/fails")
    given = ("sets =", 'results = ["febio"]\nsets =')
    assert "the run of Load1 ended with ERROR TERMINATION" in wrong(study, given)
    (study / "study.toml").write_text(STUDY.replace(given[0], f"unfinished = true\n{given[1]}"))
    told = read_study(study)
    (compare,) = (stage for stage in plan(told) if stage.kind == "compare")
    assert compare.arguments["unfinished"] is True
    notes = check(study).notes
    assert any("febio: the run of Load1 ended with ERROR TERMINATION" in note for note in notes), notes
