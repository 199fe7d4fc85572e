"""Variants of models from files: the input that was changed, by how much, and those that cannot be used."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dvc import read_labels
from dvc.errors import InputError
from mrstrain.comparison.compare import compare
from mrstrain.comparison.model_files import model_files, with_variants
from mrstrain.models.variant_files import VARIANT, VariantRecord, variant_folders
from mrstrain.options.modelling import ModelReading
from tests.mrstrain.comparison.test_compare import LOADS, given


def variant(study: Path, name: str, text: str, of: str = "half") -> Path:
    shutil.copytree(study / of, study / name)
    (study / name / VARIANT).write_text(text)
    return study / name


def test_a_variant_is_read_with_its_base_for_each_load(study: Path) -> None:
    plain = variant(study, "stronger", 'model = "right"\ninput = "force"\nsteps = 2\n')
    shutil.copytree(study / "half", study / "coarse")
    based = variant(study, "wet", 'model = "right"\ninput = "poisson"\nsteps = -1.0\nbase = "../coarse"\n')
    files, _ = model_files(list(LOADS), [study / "right", study / "half"], ModelReading())
    found, notes = with_variants(files, variant_folders([plain, based]), ModelReading())
    assert notes == []
    grid = read_labels(study / "tissues.nii.gz", study / "tissues.csv").grid
    for load in LOADS:
        right, half = found[load]
        assert half.variants == ()
        force, wet = right.read(grid).variants
        assert (force.input, force.steps, force.base, wet.input, wet.steps) == ("force", 2.0, None, "poisson", -1.0)
        assert wet.base is not None
        assert (wet.base().u_mm == half.read(grid).deformation.u_mm).all()
        assert {path.parent.name for path in right.variant_paths} == {"stronger", "wet", "coarse"}


def test_a_variant_without_a_load_is_told_and_left_out(study: Path) -> None:
    lacking = variant(study, "stronger", 'model = "right"\ninput = "force"\nsteps = 1.0\n')
    first, *others = LOADS
    (lacking / f"{first}.vtu").unlink()
    done = compare(study / "measured", [study / "right"], variants=[lacking], remarks=["As asked."], **given(study))
    assert done.comparison.notes[0] == "As asked."
    assert f"right: the variant of 'force' has no result for {first}." in done.comparison.notes
    assert not any(f"no result for {load}" in note for load in others for note in done.comparison.notes)


def test_a_result_that_is_named_after_no_load_is_told(study: Path) -> None:
    first, second = LOADS
    shutil.copytree(study / "half", study / "odd")
    (study / "odd" / f"{second}.vtu").rename(study / "odd" / "load2_final.vtu")
    files, notes = model_files(list(LOADS), [study / "odd"], ModelReading())
    assert [len(files.get(load, [])) for load in LOADS] == [1, 0]
    assert notes == [
        f"odd has no result for {second}. Its load2_final.vtu is named after no measured load ({first}, {second})."
    ]


def test_a_variant_of_a_model_that_is_not_compared_is_told(study: Path) -> None:
    place = variant(study, "stronger", 'model = "rigth"\ninput = "force"\nsteps = 1.0\n')
    files, _ = model_files(list(LOADS), [study / "right", study / "half"], ModelReading())
    found, (told,) = with_variants(files, variant_folders([place]), ModelReading())
    assert not any(model.variants for of in found.values() for model in of)
    assert told == (
        f"{place}: its variant.toml is of the model 'rigth', which is not compared. The variant is left out. Compared: "
        "right, half."
    )


def test_a_variant_whose_run_ended_early_is_told_and_left_out(study: Path) -> None:
    place = variant(study, "stronger", 'model = "right"\ninput = "force"\nsteps = 1.0\n')
    first, *others = LOADS
    (place / f"{first}.log").write_text("E R R O R   T E R M I N A T I O N")
    files, _ = model_files(list(LOADS), [study / "right"], ModelReading())
    found, notes = with_variants(files, variant_folders([place]), ModelReading())
    assert [len(found[load][0].variants) for load in LOADS] == [0, *(1 for _ in others)]
    (told,) = notes
    assert told.startswith(f"right: the variant of 'force' is left out for {first}, because the run of {place}")
    assert told.endswith(f"{first}.vtu ended with ERROR TERMINATION ({first}.log).")
    asked, notes = with_variants(files, variant_folders([place]), ModelReading(unfinished=True))
    assert (len(asked[first][0].variants), notes) == (1, [])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (None, "no folder in it has a file variant.toml"),
        ("model = ", "is not a valid TOML file"),
        ('model = "right"\ninput = "force"\n', "steps: a value is required"),
        ('model = "right"\ninput = "force"\nsteps = 0.0\n', "steps is 0; give the change of the input"),
        ('model = "right"\ninput = "force"\nsteps = "one"\n', "steps: "),
        ('model = "right"\ninput = "force"\nsteps = 1.0\nfolder = "x"\n', "folder: "),
    ],
)
def test_a_file_that_says_no_variant_is_refused(study: Path, text: str | None, told: str) -> None:
    place = study / "half" if text is None else variant(study, "wrong", text)
    with pytest.raises(InputError, match=told):
        variant_folders([place])


def test_what_is_written_is_read(tmp_path: Path) -> None:
    (tmp_path / "force").mkdir()
    record = VariantRecord.of_folders('a "b"', "force", 0.1 + 0.2, tmp_path / "mesh", tmp_path / "force")
    (tmp_path / "force" / VARIANT).write_text(record.text)
    (found,) = variant_folders([tmp_path])
    assert found.record == record
    assert found.base.resolve() == (tmp_path / "mesh").resolve()
