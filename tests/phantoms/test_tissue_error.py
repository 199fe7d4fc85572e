"""The error against a truth is what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.deformation.protocol import Affine
from dvc.deformation.strain_maps import strain_maps
from dvc.errors import GeometryError
from dvc.images.image import Grid, LabelMap, Mask
from phantoms import errors_by_tissue, errors_of_maps

GRID = Grid((8, 6, 5), (1.0, 1.5, 2.0), (-4.0, 3.0, 1.0))
STRETCH = np.diag([1.2, 1.0, 1.0])


def labels() -> LabelMap:
    numbers = np.ones(GRID.shape, dtype=np.int64)
    numbers[4:] = 2
    numbers[:, 0] = 0
    return LabelMap(GRID, numbers, {1: "fat", 2: "skin", 3: "tendon"})


def test_error_of_a_known_stretch_and_shift() -> None:
    truth = Affine(np.eye(3), np.zeros(3))
    found = Affine(STRETCH, -STRETCH @ GRID.centre_mm + GRID.centre_mm + [0.0, 0.3, 0.0])
    everywhere = np.ones(GRID.shape, dtype=bool)
    fat, skin = errors_by_tissue(labels(), truth, found, everywhere)
    assert (fat.tissue, fat.voxels, skin.tissue, skin.voxels) == ("fat", 100, "skin", 100)
    shear = (1.2**2 - 1) / 4
    for row in (fat, skin):
        assert (row.true_p50, row.true_p95, row.folded) == (0.0, 0.0, 0)
        assert [row.shear_rmse, row.shear_bias, row.shear_error_p95] == pytest.approx([shear] * 3, rel=1e-9)
    lengths = np.hypot(0.2 * np.array([0.5, 1.5, 2.5, 3.5]), 0.3)  # of either half, from the middle
    assert fat.u_p50_mm == pytest.approx(np.median(lengths), rel=1e-9)


def test_bias_has_its_sign_and_folds_are_counted() -> None:
    everywhere = np.ones(GRID.shape, dtype=bool)
    rest = Affine(np.eye(3), np.zeros(3))
    missed = errors_by_tissue(labels(), Affine(STRETCH, np.zeros(3)), rest, everywhere)[0]
    assert missed.shear_bias == pytest.approx(-(1.2**2 - 1) / 4, rel=1e-9)
    mirrored = errors_by_tissue(labels(), rest, Affine(np.diag([-1.0, 1.0, 1.0]), np.zeros(3)), everywhere)[0]
    assert mirrored.folded == mirrored.voxels


def test_only_the_voxels_asked_for_are_scored() -> None:
    rest = Affine(np.eye(3), np.zeros(3))
    where = np.zeros(GRID.shape, dtype=bool)
    where[:2] = True
    rows = errors_by_tissue(labels(), rest, rest, where)
    assert [(row.tissue, row.voxels) for row in rows] == [("fat", 50)]
    with pytest.raises(GeometryError, match=r"but the labels have shape"):
        errors_by_tissue(labels(), rest, rest, where[:-1])


def test_maps_tell_the_error_of_the_deformations_that_they_were_made_of() -> None:
    truth, found = Affine(STRETCH, np.zeros(3)), Affine(STRETCH.T[::-1, ::-1], np.array([0.0, 0.3, 0.0]))
    where = np.ones(GRID.shape, dtype=bool)
    where[2] = False
    true, measured = strain_maps(truth, Mask(GRID, labels().labels > 0)), strain_maps(found, Mask(GRID, where))
    from_maps = errors_of_maps(labels(), true, measured)
    for row, wanted in zip(from_maps, errors_by_tissue(labels(), truth, found, where), strict=True):
        assert (row.tissue, row.voxels, row.folded) == (wanted.tissue, wanted.voxels, wanted.folded)
        figures = ("true_p50", "true_p95", "shear_rmse", "shear_bias", "shear_error_p95", "u_p50_mm", "u_p95_mm")
        for name in figures:
            assert getattr(row, name) == pytest.approx(getattr(wanted, name), rel=1e-6, abs=1e-7), name
    other = Grid(GRID.shape, GRID.spacing_mm, GRID.origin_mm + 1.0)
    with pytest.raises(GeometryError, match="true maps"):
        errors_of_maps(labels(), strain_maps(truth, Mask(other, where)), measured)
