"""Files of the error bars of a load: what is missing or damaged is refused, and former versions are read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import ImageFileError, InputError
from dvc.io import result_folder as files
from dvc.io.error_files import read_uncertainty, write_uncertainty
from dvc.trust.components import components_of
from dvc.trust.error_model import POOLED, ErrorModel
from dvc.trust.uncertainty import Interval, Uncertainty
from dvc.trust.verdict import Verdict
from tests.dvc.trust.test_field_draws import FAR, GRID, HALF, ROWS, TABLE, maps

REGIONS = {"fat": HALF, "scar, old": ~HALF}
SURE = Uncertainty(FAR, (Interval("fat", "median", 0.3, 0.29, 0.2, 0.4),), TABLE, REGIONS, FAR)
VERDICT = Verdict("trust", ())


def written(folder: Path, sure: Uncertainty) -> None:
    write_uncertainty(folder, GRID, sure, ErrorModel("mine", "", (sure.table,), "made up"), VERDICT)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    written(tmp_path, replace(SURE, components=components_of(maps(), REGIONS, FAR, TABLE)))
    return tmp_path


def test_tissues_distances_and_components_are_read_as_they_were_written(folder: Path) -> None:
    sure, _ = read_uncertainty(folder, GRID)
    assert list(sure.regions) == list(REGIONS)
    for name, inside in REGIONS.items():
        np.testing.assert_array_equal(sure.regions[name], inside)
    np.testing.assert_array_equal(sure.to_bone_mm, FAR)
    rows = {(row.region, row.component): row for row in sure.components.rows}
    assert rows["scar, old", "xy"].mean == pytest.approx(0.1)
    assert rows["scar, old", "xy"].voxel_standard_uncertainty == pytest.approx(0.02)
    assert rows["fat", "z"].voxel_standard_uncertainty == pytest.approx(0.4)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def without_last_cell(path: Path) -> None:
    path.write_text(path.read_text().rstrip().rpartition(",")[0] + "\n")


@pytest.mark.parametrize(
    ("name", "harm"),
    [
        *((name, cut) for name in (files.SIGMA_SHEAR, files.SOFT_TISSUES, files.TO_BONE)),
        *((name, Path.unlink) for name in (files.SIGMA_NORMAL, files.SIGMA_DISPLACEMENT, files.COMPONENTS)),
        *((name, Path.unlink) for name in (files.SOFT_TISSUES, files.TO_BONE, "soft_tissues.csv")),
        ("soft_tissues.csv", lambda path: path.write_text("label,name\n1,fat\n")),
        (files.COMPONENTS, without_last_cell),
        (files.INTERVALS, without_last_cell),
    ],
)
def test_damaged_files_are_refused_by_name(folder: Path, name: str, harm) -> None:
    harm(folder / name)
    with pytest.raises((InputError, ImageFileError)) as refused:
        read_uncertainty(folder, GRID)
    assert name in str(refused.value)


def test_a_folder_of_a_former_version_is_read_without_components(tmp_path: Path) -> None:
    short = {POOLED: ROWS[:2]}
    written(tmp_path, replace(SURE, table=replace(TABLE, whole=short, runs=(short,)), regions={}, to_bone_mm=None))
    assert not (tmp_path / files.SOFT_TISSUES).exists()
    assert not (tmp_path / files.BIAS).exists()
    sure, _ = read_uncertainty(tmp_path, GRID)
    assert (sure.bias, sure.components, sure.to_bone_mm, sure.regions) == (None, None, None, {})
    assert sure.intervals == SURE.intervals
