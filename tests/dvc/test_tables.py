"""Tables of other programs: what is cut or ambiguous is refused, with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from dvc.errors import InputError
from dvc.tables import read_table, refuse_damaged_toml, refuse_half_a_line


def test_cells_have_their_line_and_no_blanks(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text('\ufeff# ours\nNode , "Name"\n\n 1 , "a, b"\n2,\n3,c,,\n', encoding="utf-8")
    assert read_table(path) == (["node", "name"], [(4, ["1", "a, b"]), (5, ["2", ""]), (6, ["3", "c"])])
    path.write_text("")
    assert read_table(path) == ([], [])


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"a,b\n1\n", "line 2: the row has 1 cells, but the header has 2"),
        (b"a,b\n1,2\n0,5,1,5\n", "line 3: the row has 4 cells, but the header has 2. .*decimal commas"),
        (b'a,b\n1,"two', "line 2: cannot be read as a row of a table"),
        (b"a,b\n1,2", "the file may be incomplete: it ends in the middle of a line"),
        (b"a;b\n1;2\n", "separated by semicolons"),
        (b"a,b\n\xff,1\n", "cannot be read as text"),
        (b"a,b\n1," + b"2" * 200_000 + b"\n", "line 2: cannot be read as a row of a table"),
    ],
)
def test_a_damaged_table_is_refused_with_its_line(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    with pytest.raises(InputError, match=rf"t\.csv.*{message}"):
        read_table(path)


def test_a_file_that_ends_within_a_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    for whole in (b"1\n", b"1\r\n", b"1\r"):
        path.write_bytes(whole)
        refuse_half_a_line(path)
    path.write_bytes(b"1")
    with pytest.raises(InputError, match="in the middle of a line"):
        refuse_half_a_line(path)


@pytest.mark.parametrize("whole", ["", "a = 1\n", "a = 1 # of 2", 'a = "1"', "a = [1]", "a = true", "# 1"])
def test_a_toml_file_that_ends_within_a_number_is_refused(whole: str) -> None:
    refuse_damaged_toml("a.toml", whole, {})
    with pytest.raises(InputError, match=r"a\.toml: the file may be incomplete: it ends in the middle of a line"):
        refuse_damaged_toml("a.toml", f"{whole}\nb = 14", {})


def test_a_toml_file_with_a_null_character_is_refused() -> None:
    content = {"a": {"b": ["x", "y\0"]}}
    with pytest.raises(InputError, match=r"a\.toml: b has a null character"):
        refuse_damaged_toml("a.toml", "", content)
