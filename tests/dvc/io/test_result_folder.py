"""Maps, axes and points that are written: every component against a closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.deformation.protocol import Affine
from dvc.deformation.strain import StrainField, plate_axes
from dvc.deformation.strain_maps import strain_maps
from dvc.errors import InputError
from dvc.images.image import Grid, Image, Mask
from dvc.io.result_folder import QUALITY, REGIONS, ResultFolder, in_axes
from dvc.measurement.subject import Subject
from dvc.trust.quality import read_noise_floor
from dvc.trust.regions import read_regions_csv

GRID = Grid((5, 6, 7), np.array([1.0, 1.5, 2.0]), np.array([-3.0, 4.0, 8.0]))
MATRIX = np.array([[1.08, 0.11, -0.05], [0.02, 0.93, 0.17], [-0.09, 0.04, 1.03]])


def test_all_six_components_of_a_general_affine_motion_are_its_own():
    E = 0.5 * (MATRIX.T @ MATRIX - np.eye(3))
    expected = [E[0, 0], E[0, 1], E[0, 2], E[1, 1], E[1, 2], E[2, 2]]
    assert np.abs(np.subtract.outer(expected, expected)[~np.eye(6, dtype=bool)]).min() > 0.003  # no two are alike
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[1:4, 2:, :5] = True
    motion = Affine(MATRIX, np.array([0.3, -0.2, 0.5]))
    maps = strain_maps(motion, Mask(GRID, inside))
    assert np.array_equal(maps.valid, inside)
    for c, value in enumerate(expected):
        np.testing.assert_allclose(maps.green_lagrange[inside][:, c], value, atol=1e-6)
    assert np.isnan(maps.green_lagrange[~inside]).all()
    principal = np.linalg.eigvalsh(E)
    np.testing.assert_allclose(maps.max_shear[inside], 0.5 * (principal[2] - principal[0]), atol=1e-6)
    np.testing.assert_allclose(maps.jacobian[inside], np.linalg.det(MATRIX), atol=1e-6)
    np.testing.assert_allclose(maps.displacement_mm[inside], motion.displacement(GRID.points(inside)), atol=1e-5)


def test_strain_in_the_plates_axes_is_that_of_the_kinematics():
    H = 0.3 * np.random.default_rng(4).normal(size=(20, 3, 3))
    axes = plate_axes([0.3, -0.2, -1.0], [0.1, -1.0, 0.4])
    strain = StrainField.from_gradient(H)
    upper = np.triu_indices(3)
    packed = strain.green_lagrange[:, upper[0], upper[1]].astype(np.float32)
    expected = strain.components_in(axes)[:, upper[0], upper[1]]
    np.testing.assert_allclose(in_axes(packed, axes), expected, atol=1e-6)
    assert np.abs(in_axes(packed, axes.T) - expected).max() > 0.01


@pytest.mark.parametrize(
    ("normal", "lowest"),
    [((0.0, 0.0, -1.0), (1, 4, 0)), ((0.0, 0.9, -0.436), (1, 5, 1)), ((-1.0, 0.0, 0.0), (0, 2, 6))],
)
def test_the_lowest_point_of_the_bone_lies_furthest_along_the_plates_normal(normal, lowest):
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[[1, 1, 0, 2], [4, 5, 2, 3], [0, 1, 6, 5]] = True
    subject = Subject(
        Image(GRID, np.arange(210.0).reshape(GRID.shape)), Mask(GRID, inside), None, None, None, np.array(normal), None
    )
    np.testing.assert_allclose(subject.lowest_bone_point_mm, GRID.points_at(np.array(lowest, dtype=np.float64)))
    assert replace(subject, bone=None).lowest_bone_point_mm is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"verdict": {"level": "tr\xffst", "reasons": []}}', "can't decode"),
        (b'{"verdict": {"level": "trust", "reasons": []}', "cannot be read"),
        (b"[" * 100_000, "cannot be read"),
        (b'["verdict"]', "a list, not an object"),
        (b'{"verdict": {"level": "trust", "reasons": []}, "mean": NaN}', "NaN is no number"),
        (b'{"verdict": {"level": "trust", "reasons": []}, "mean": 1e400}', "1e400 is no number"),
        (b'{"verdict": {"level": "trust", "reasons": []}, "alignment": []}', "the verdict or the alignment is"),
        (b'{"verdict": {"level": "trust"}}', "the verdict or the alignment is"),
    ],
    ids=lambda given: str(given)[:60],
)
def test_a_damaged_quality_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / QUALITY).write_bytes(content)
    with pytest.raises(InputError, match=rf"quality\.json: .*{message}"):
        ResultFolder.at(tmp_path)


@pytest.mark.parametrize("name", [QUALITY, REGIONS])
def test_a_refusal_of_a_file_that_is_no_text_does_not_quote_it(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"of a patient\n" * 100 + b"\xff")
    reader = read_noise_floor if name == QUALITY else read_regions_csv
    with pytest.raises(InputError, match=rf"{name}: .*can't decode byte 0xff") as refusal:
        reader(tmp_path / name)
    assert "patient" not in str(refusal.value)
