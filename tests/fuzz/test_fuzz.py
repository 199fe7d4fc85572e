"""Every reader reads its valid files and survives a little damage; and `python -m tests.fuzz` sees what escapes."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from tests.fuzz import planted
from tests.fuzz.__main__ import main
from tests.fuzz.damage import Reader, damage_one, read_or_refuse, written
from tests.fuzz.readers import READERS


@pytest.mark.parametrize("name", READERS)
def test_a_reader_reads_valid_files_and_reads_or_refuses_damaged_ones(name: str, tmp_path: Path) -> None:
    files = written(READERS[name], tmp_path / name)
    for path in files:
        READERS[name].read(path)
    for number in range(10):
        path = damage_one(files, Random(f"{name} {number}"))
        read_or_refuse(READERS[name].read, path)
        path.write_bytes(files[path])


def test_each_kind_of_escape_is_seen_kept_and_told(tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    readers = {read.__name__: Reader(planted.write, read) for read in (planted.raises, planted.hangs, planted.dies)}
    assert main(readers, ["--seconds", "0", "--limit-s", "3", "--keep", str(tmp_path)]) == 1
    told = capfd.readouterr().out
    for name, what in {
        "raises": "ValueError",
        "hangs": "no answer within 3 s",
        "dies": "the process died (-6)",
    }.items():
        (kept,) = tmp_path.glob(f"{name}-*/a.txt")
        assert kept.read_bytes() != planted.VALID
        assert f"{what} at tests/fuzz/planted.py:" in kept.with_name("told.txt").read_text()
        assert f"{name}: {what} at tests/fuzz/planted.py:" in told
        assert f"python -m tests.fuzz {name} --again '{kept}'" in told
    assert main(readers, ["raises", "--again", str(next(tmp_path.glob("raises-*/a.txt")))]) == 1
    assert "ValueError: not one of ours" in capfd.readouterr().err


def test_a_reader_that_nothing_escapes_is_no_failure(tmp_path: Path) -> None:
    assert main({"sound": Reader(planted.write, Path.read_bytes)}, ["--seconds", "0", "--keep", str(tmp_path)]) == 0
    assert list(tmp_path.iterdir()) == []
