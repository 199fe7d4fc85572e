"""Paths that no file can have, texts nested without end, and numbers of hundreds of digits: refused, not escaped."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

import dvc
import fe
import mrstrain
from dvc.errors import InputError, OutputError
from dvc.file_names import refuse_path
from dvc.io.images.labels import read_names
from dvc.io.transforms.itk_file import read_itk_transform
from dvc.own_files import parse_json, parse_toml
from mrstrain.records.inputs import make_output
from mrstrain.records.outcome import wrong_path
from mrstrain.studies.file import read_study

DEEP, HUGE, LONG = "[" * 100_000, "9" * 400, "x" * 300
NOT_UTF8 = os.fsdecode(b"M\xfcller")


@pytest.mark.parametrize("read", [parse_json, parse_toml])
def test_nesting_without_end_is_refused(read: Callable[[str], object]) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        read(DEEP if read is parse_json else f"a = {DEEP}")
    with pytest.raises(ValueError, match="nested too deeply"):
        read('{"a":' * 100_000 if read is parse_json else f"{'.'.join('a' * 3000)} = 1")


def test_whole_numbers_are_refused_from_64_bits_on() -> None:
    assert parse_toml(f"a = {2**63 - 1}\nb = [{-(2**63)}]") == {"a": 2**63 - 1, "b": [-(2**63)]}
    for text in (f"a = {2**63}", f"a = [[{HUGE}]]", f"[a]\nb = {HUGE}", f"a = {'1' * 5000}"):
        with pytest.raises(ValueError, match=r"more than 18 digits|limit"):
            parse_toml(text)
    with pytest.raises(ValueError, match="no number"):
        parse_json(f'{{"a": {HUGE}}}')


@pytest.mark.parametrize("odd", [f"x = {DEEP}", f"x = {HUGE}", f"x = {'1' * 5000}"])
def test_studies_and_material_sets_with_such_texts_are_refused(odd: str, tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    file.write_text(f"{odd}\n")
    with pytest.raises(InputError, match=r"study\.toml"):
        read_study(file)
    with pytest.raises(InputError, match=r"study\.toml"):
        fe.read_material_sets(file)


@pytest.mark.parametrize("number", [DEEP, f'{{"markups": [{{"coordinateSystem": {HUGE}}}]}}'])
def test_a_point_list_with_such_a_text_is_refused(number: str, tmp_path: Path) -> None:
    for name in ("a.mrk.json", "b.mrk.json"):
        (tmp_path / name).write_text(number)
    with pytest.raises(InputError, match="one point list"):
        dvc.read_landmarks((tmp_path / "a.mrk.json", tmp_path / "b.mrk.json"))


def test_a_label_of_thousands_of_digits_is_no_label(tmp_path: Path) -> None:
    table = tmp_path / "names.csv"
    table.write_text(f"label,name\n1,fat\n{'2' * 5000},skin\n")
    with pytest.raises(InputError, match=r"names\.csv"):
        read_names(table)


@pytest.mark.parametrize(
    "call",
    [
        lambda path: mrstrain.register(path, ["Load1.nii.gz"], out="out"),
        lambda path: mrstrain.register("Load0.nii.gz", [path], out="out"),
        lambda path: mrstrain.register("Load0.nii.gz", ["Load1.nii.gz"], out=path),
        lambda path: mrstrain.register("Load0.nii.gz", ["Load1.nii.gz"], out="out", bone=path),
        lambda path: mrstrain.simulate("heel.vtu", out=path),
        lambda path: mrstrain.mesh(labels=path, out="heel.vtu", edge_mm=2.0),
        fe.read_curves,
        lambda path: fe.material_set(f"{path}.toml"),
        mrstrain.check,
    ],
)
@pytest.mark.parametrize(("path", "why"), [("a\0b", "null character"), (LONG, r"a name of 30[0-9] bytes")])
def test_a_path_that_no_file_can_have_is_refused(call: Callable[[str], object], path: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        call(path)


def test_the_longest_name_is_that_of_most_bytes() -> None:
    with pytest.raises(InputError, match="a name of 400 bytes"):
        refuse_path("é" * 200 + "/" + "a" * 201)
    refuse_path("\ud800")
    with pytest.raises(InputError, match="is empty"):  # Path makes the current folder of it
        refuse_path("")


@pytest.mark.skipif(os.name == "nt", reason="paths are Unicode there")
def test_paths_that_native_libraries_cannot_open_are_refused_before_they_end_the_process(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="not UTF-8"):
        make_output(tmp_path / NOT_UTF8)
    with pytest.raises(InputError, match="only paths in UTF-8"):
        read_itk_transform(tmp_path / NOT_UTF8 / "motion.tfm")


def test_the_system_s_own_words_on_a_path_come_with_what_to_do(tmp_path: Path) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path in (loop, tmp_path / LONG):
        with pytest.raises((OSError, RuntimeError)) as failure:
            (path.resolve(strict=True) / "a").read_text()
        assert wrong_path(failure.value).endswith("Check this path.")
    assert wrong_path(FileNotFoundError(2, "No such file", "a")) == ""
