"""Uncertainty of components, and true fields drawn: they vary as the error table says, alike in all axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.images.image import Grid
from dvc.trust.components import components_of
from dvc.trust.error_model import POOLED, ErrorTable
from dvc.trust.field_draws import FieldDraws, isotropic

GRID = Grid((24, 24, 24), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
FIGURES = np.array([0.01, 0.02, 0.1, 0.03, 0.02, 0.4])  # bias, sd, shrinkage, normal, shear, displacement
ROWS = np.tile(FIGURES[:, None, None], (1, 2, 2))
TABLE = ErrorTable(
    spacing_mm=np.ones(3),
    snr=25.0,
    shear=np.array([0.0, 0.5]),
    to_bone_mm=np.array([0.0, 4.0]),
    whole={POOLED: ROWS, "fat": ROWS},
    runs=({POOLED: ROWS, "fat": ROWS},),
    correlation_mm=3.0,
    component_correlation_mm=(2.0, 4.0),
)
HALF = np.zeros(GRID.shape, dtype=bool)
HALF[:, :, :12] = True
FAR = np.full(GRID.shape, 9.0, dtype=np.float32)


def maps(shear: float = 0.3) -> StrainMaps:
    """Uniform fields."""

    def full(*values: float) -> np.ndarray:
        return np.tile(np.array(values, dtype=np.float32), (*GRID.shape, 1))

    valid = np.ones(GRID.shape, dtype=bool)
    strain = full(0.2, 0.1, 0.0, -0.1, 0.0, 0.05)
    return StrainMaps(GRID, valid, full(1.0, -2.0, 3.0), strain, full(shear)[..., 0], full(1.0)[..., 0])


def test_components_have_the_uncertainty_of_the_table_in_soft_tissue_alone() -> None:
    rows = ROWS.copy()
    rows[:, 1] *= np.array([1.0, 2.0, 1.0, 2.0, 3.0, 4.0])[:, None]  # far from bone
    table, to_bone = replace(TABLE, whole={POOLED: ROWS, "fat": rows}), FAR.copy()
    to_bone[:12] = 1.0
    found = components_of(maps(), {"fat": HALF}, to_bone, table, {"fat": 1.5})
    assert found is not None
    for sigma, near, far in (
        (found.normal_strain, 0.045, 0.09),
        (found.shear_strain, 0.03, 0.09),
        (found.displacement_mm, 0.6, 2.4),
    ):
        assert np.isnan(sigma[~HALF]).all()
        np.testing.assert_allclose(sigma[:12, :, :12], near, rtol=1e-5)
        np.testing.assert_allclose(sigma[12:, :, :12], far, rtol=1e-5)
    np.testing.assert_allclose(found.strain_bias[HALF], 0.1)
    row = {r.component: r for r in found.rows}
    assert (row["xx"].bias, row["yy"].bias, row["z"].bias) == pytest.approx((0.02, -0.01, 0.0))
    assert list(row) == ["x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz"]
    assert (row["y"].mean, row["y"].unit) == (pytest.approx(-2.0), "mm")
    assert row["zz"].voxel_standard_uncertainty == pytest.approx(np.sqrt(np.mean(np.square([0.045, 0.09]))))
    assert row["xz"].voxel_expanded_uncertainty == pytest.approx(2.0 * row["xz"].voxel_standard_uncertainty)


def test_tables_without_components_have_neither() -> None:
    short = {POOLED: ROWS[:2], "fat": ROWS[:2]}
    former = replace(TABLE, whole=short, runs=(short,))
    assert components_of(maps(), {"fat": HALF}, FAR, former) is None
    with pytest.raises(InputError, match="errors of displacement and strain components"):
        FieldDraws(maps(), {"fat": HALF}, FAR, former)


def test_noise_of_a_tensor_is_the_same_in_all_axes() -> None:
    """Deviations of normal and shear components, and the correlation of normal ones, before and after a rotation."""
    random = np.random.default_rng(7)
    turn = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
    one = np.ones(60_000)
    for normal, shear in ((0.03, 0.02), (0.02, 0.0173)):
        noise = isotropic(*random.standard_normal((2, 3, len(one))), normal * one, shear * one)
        full = noise[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        for tensor in (full, turn.T @ full @ turn):
            diagonal = tensor[:, [0, 1, 2], [0, 1, 2]]
            np.testing.assert_allclose(diagonal.std(axis=0), normal, rtol=0.02)
            np.testing.assert_allclose(tensor[:, [0, 0, 1], [1, 2, 2]].std(axis=0), shear, rtol=0.02)
            alike = np.corrcoef(diagonal.T)[[0, 0, 1], [1, 2, 2]]
            np.testing.assert_allclose(alike, 1.0 - 2.0 * (shear / normal) ** 2, atol=0.02)
    less = isotropic(*random.standard_normal((2, 3, len(one))), 0.02 * one, 0.03 * one)  # no isotropic tensor does that
    np.testing.assert_allclose(less.std(axis=0), [0.02, 0.03, 0.03, 0.02, 0.03, 0.02], rtol=0.02)


def test_a_part_of_a_components_error_is_that_of_the_whole_tissue() -> None:
    """A quarter of the variance of the displacement, and none of that of the strain: their means vary accordingly."""
    table = replace(TABLE, shared={POOLED: np.array([0.0, 0.25])})
    draws = FieldDraws(maps(), {"fat": HALF}, FAR, table, seed=4)
    some = [draws.drawn() for _ in range(150)]
    u = np.array([d.displacement_mm[HALF] for d in some])
    np.testing.assert_allclose(u.std(axis=0).mean(axis=0), 0.4, rtol=0.1)
    np.testing.assert_allclose(u.mean(axis=1).std(axis=0), 0.2, rtol=0.2)
    E = np.array([d.green_lagrange[HALF] for d in some])
    assert (E.mean(axis=1).std(axis=0) < 0.004).all()


def test_draws_vary_as_the_table_says_and_neighbours_alike() -> None:
    draws = FieldDraws(maps(), {"fat": HALF}, FAR, TABLE, seed=3)
    some = [draws.drawn() for _ in range(60)]
    for name in ("displacement_mm", "green_lagrange", "max_shear"):
        assert np.isnan(getattr(some[0], name)[~HALF]).all()
    shear = np.array([d.max_shear[HALF] for d in some])
    assert shear.mean() == pytest.approx(0.29, abs=0.002)
    assert shear.std(axis=0).mean() == pytest.approx(0.02, rel=0.05)
    E = np.array([d.green_lagrange[HALF] for d in some])
    np.testing.assert_allclose(E.mean(axis=(0, 1)), 0.9 * np.array([0.2, 0.1, 0.0, -0.1, 0.0, 0.05]), atol=0.003)
    np.testing.assert_allclose(E.std(axis=0).mean(axis=0), [0.03, 0.02, 0.02, 0.03, 0.02, 0.03], rtol=0.05)
    u = np.array([d.displacement_mm[:, :, :12] for d in some]) - np.array([1.0, -2.0, 3.0])
    np.testing.assert_allclose(u.std(axis=0).mean(axis=(0, 1, 2)), 0.4, rtol=0.05)
    alike = [np.mean(u[:, : 24 - lag] * u[:, lag:]) / np.mean(u**2) for lag in (2, 4)]
    np.testing.assert_allclose(alike, np.exp([-0.25, -1.0]), atol=0.08)


def test_a_draw_errs_as_one_registration_did() -> None:
    """Two registrations without noise, of shears 0.03 too high and too low, and strains a fifth too large and small."""
    quiet = {sign: sign * ROWS * np.array([3.0, 0.0, 2.0, 0.0, 0.0, 0.0])[:, None, None] for sign in (1.0, -1.0)}
    table = replace(TABLE, runs=tuple({POOLED: np.abs(own) * sign} for sign, own in quiet.items()))
    draws = FieldDraws(maps(), {"fat": HALF}, FAR, table, seed=1)
    shear, xx = set(), set()
    for _ in range(12):
        field = draws.drawn()
        assert np.ptp(field.max_shear[HALF]) < 1e-6
        shear.add(round(float(field.max_shear[HALF][0]), 4))
        xx.add(round(float(field.green_lagrange[HALF][0, 0]), 4))
    assert shear == {0.27, 0.33}
    assert xx == {0.16, 0.24}


def test_draws_are_wider_in_tissues_whose_error_bars_did_not_hold() -> None:
    """All deviations of the fat are three times as large, and those of other tissue are not; bias and mean stay."""
    uniform = maps(shear=0.5)
    draws = FieldDraws(uniform, {"fat": HALF, "muscle": ~HALF}, FAR, TABLE, seed=3, wider={"fat": 3.0})
    some = [draws.drawn() for _ in range(40)]
    for name, sizes in (
        ("max_shear", 0.02),
        ("green_lagrange", [0.03, 0.02, 0.02, 0.03, 0.02, 0.03]),
        ("displacement_mm", 0.4),
    ):
        values = np.array([getattr(d, name) for d in some])
        for where, factor in ((HALF, 3.0), (~HALF, 1.0)):
            spread = values[:, where].std(axis=0).mean(axis=0)
            np.testing.assert_allclose(spread, factor * np.asarray(sizes), rtol=0.06, err_msg=name)
    assert np.mean([d.max_shear[HALF] for d in some]) == pytest.approx(0.49, abs=0.005)


@pytest.mark.parametrize("regions", [{}, {"fat": np.zeros(GRID.shape, dtype=bool)}])
def test_draws_without_a_voxel_are_refused(regions: dict) -> None:
    with pytest.raises(InputError, match="no soft tissue whose strain is known"):
        FieldDraws(maps(), regions, FAR, TABLE)
