"""JSON, CSV and npz files of our own: read as they were written, or refused in one way whatever is wrong with them."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from dvc.own_files import read_arrays, read_json, read_rows

KEPT = {"counts": np.arange(40.0), "name": np.array("a name")}


def test_every_byte_of_an_npz_file_counts(tmp_path: Path) -> None:
    """Each byte changed in turn: the same arrays, or a ValueError, and never other values."""
    path = tmp_path / "kept.npz"
    np.savez_compressed(path, **KEPT)
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << at % 8)]) + whole[at + 1 :])
        with suppress(ValueError):
            found = read_arrays(path)
            for name in KEPT.keys() & found.keys():
                np.testing.assert_array_equal(found[name], KEPT[name])


def test_an_array_longer_than_its_header_tells_is_refused(tmp_path: Path) -> None:
    """The bytes that are not read would not count in the checksum."""
    path = tmp_path / "kept.npz"
    np.savez(path, **KEPT)
    whole = path.read_bytes()
    at = whole.index(b"(40,)")
    path.write_bytes(whole[:at] + b"(39,)" + whole[at + 5 :])
    with pytest.raises(ValueError, match="damaged"):
        read_arrays(path)


@pytest.mark.parametrize("content", [b"", b"PK", b"\x93NUMPY\x01\x00", struct.pack("<300d", *range(300))])
def test_what_is_no_npz_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "other.npz").write_bytes(content)
    with pytest.raises(ValueError, match="no arrays"):
        read_arrays(tmp_path / "other.npz")


@pytest.mark.parametrize(
    "text",
    ["", "[1]", "null", "{", "[" * 100_000, '{"a": NaN}', '{"a": [-Infinity]}', '{"a": 1e400}', '{"a": 1' + "0" * 99],
)
def test_json_that_no_file_of_ours_holds_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ValueError):  # noqa: PT011 - of any kind
        read_json(tmp_path / "a.json")


def test_numbers_of_json_are_kept(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": [1, -2.5e-3, null, true]}')
    assert read_json(tmp_path / "a.json") == {"a": [1, -2.5e-3, None, True]}


def test_a_table_is_read_by_the_names_of_its_columns(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text('load,n\n"#1, ""slow""",2.5\n')
    assert read_rows(tmp_path / "a.csv") == [{"load": '#1, "slow"', "n": "2.5"}]


@pytest.mark.parametrize(
    "table", [b"", b"load,n\nA\n", b"load,n\nA,1,2\n", b'load,n\n"A,1\n', b'load,n\n"A"x,1\n', b"load,n\n\xff,1\n",
              b"load,n\n\n", b"load,n\n" + b"A" * 200_000 + b",1\n"]
)  # fmt: skip
def test_a_damaged_table_is_refused(tmp_path: Path, table: bytes) -> None:
    (tmp_path / "a.csv").write_bytes(table)
    with pytest.raises(ValueError):  # noqa: PT011 - of any kind
        read_rows(tmp_path / "a.csv")
