"""Folders that take their name only when they are complete."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from dvc.atomic_files import remove_partial, whole_folder
from dvc.errors import OutputError
from tests.processes import ended_process


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder of an earlier run, with one file."""
    folder = tmp_path / "Load1"
    folder.mkdir()
    (folder / "quality.json").write_text("old")
    return folder


def half_filled(folder: Path, error: Exception) -> None:
    with whole_folder(folder) as partial:
        (partial / "regions.csv").write_text("half")
        raise error


def test_a_folder_is_replaced_as_a_whole(old: Path) -> None:
    with whole_folder(old) as partial:
        (partial / "regions.csv").write_text("new")
        assert (old / "quality.json").read_text() == "old"
    assert [p.name for p in old.parent.iterdir()] == ["Load1"]
    assert [p.name for p in old.iterdir()] == ["regions.csv"]


def test_a_disk_that_fills_midway_leaves_the_old_folder_and_nothing_else(old: Path) -> None:
    with pytest.raises(OutputError, match=r"Load1: .*No space left"):
        half_filled(old, OSError(errno.ENOSPC, "No space left on device"))
    assert [p.name for p in old.parent.iterdir()] == ["Load1"]
    assert [p.name for p in old.iterdir()] == ["quality.json"]


def test_an_error_that_is_none_of_the_disk_stays_itself(old: Path) -> None:
    with pytest.raises(KeyError):
        half_filled(old.with_name("Load2"), KeyError("a region"))
    assert [p.name for p in old.parent.iterdir()] == ["Load1"]


def test_a_folder_that_cannot_take_its_name_gives_it_back(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old folder has been moved aside when the new one's renaming fails."""
    rename = Path.replace

    def refusing(self: Path, target: Path) -> Path:
        if self.name.endswith(".partial"):
            raise OSError(errno.EACCES, "Permission denied")
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", refusing)
    with pytest.raises(OutputError, match="Permission denied"), whole_folder(old) as partial:
        (partial / "regions.csv").write_text("new")
    assert [p.name for p in old.parent.iterdir()] == ["Load1"]
    assert (old / "quality.json").read_text() == "old"


def test_folders_that_a_killed_process_left_go_with_the_next(tmp_path: Path) -> None:
    final, beside = tmp_path / "Load1", [".Load1.a.12345678.partial", ".Load1.lock", ".Load12.12345678.partial"]
    for name in (".Load1.ab_45678.partial", ".Load1.12345678.old", *beside):
        (tmp_path / name).mkdir()
        (tmp_path / name / "displacement.nii.gz").write_text("half")
    with pytest.raises(KeyboardInterrupt), whole_folder(final):
        raise KeyboardInterrupt
    assert len(list(tmp_path.iterdir())) == 5  # an older result may be among them
    with whole_folder(final) as part:
        (part / "displacement.nii.gz").write_text("whole")
    assert {path.name for path in tmp_path.iterdir()} == {"Load1", *beside}


def test_files_begun_by_a_process_that_is_gone_are_removed_and_all_others_stay(tmp_path: Path) -> None:
    names = [
        f".{ended_process()}.partial.report.html",
        f".{os.getpid()}.partial.report.html",
        ".x.partial.a.csv",
        "report.html",
    ]
    for name in names:
        (tmp_path / name).write_text("half")
    remove_partial(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(names[1:])
