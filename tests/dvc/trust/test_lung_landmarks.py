"""Transforms and landmarks of other people: elastix' own test data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dvc.io.transforms.read import read_transform


def test_lung_landmarks(real_data: Path, tmp_path: Path) -> None:
    """elastix' own test data: 100 landmarks, an affine and a B-spline on top of it."""
    folder = real_data / "lung-landmarks"
    fixed, moving = (
        np.loadtxt(folder / f"3DCT_lung_{name}.txt", skiprows=2) for name in ("baseline_landmarks", "groundtruth_point")
    )
    affine = tmp_path / "transformparameters.3DCT_lung.affine.txt"
    affine.write_text((folder / affine.name).read_text())
    (given,) = folder.glob("*.bspline.*.txt.in")
    both = tmp_path / given.name.removesuffix(".in")
    both.write_text(given.read_text().replace("@ELASTIX_DATA_DIR@", str(tmp_path)))

    def errors(x: np.ndarray) -> np.ndarray:
        return np.linalg.norm(x - moving, axis=1)

    after_affine = fixed + read_transform(affine).displacement(fixed)
    x = fixed + read_transform(both).displacement(fixed)
    outside = np.isnan(x).any(axis=1)
    assert errors(fixed).mean() == pytest.approx(34.27, abs=0.005)
    assert errors(after_affine).mean() == pytest.approx(9.27, abs=0.005)
    # Half of the landmarks lie beyond the B-spline's region. elastix leaves them where the affine map put
    # them; with that the error is 7.51 mm. Here they are undefined; the rest shows what the B-spline does.
    assert outside.sum() == 49
    assert errors(np.where(outside[:, None], after_affine, x)).mean() == pytest.approx(7.51, abs=0.005)
    assert errors(after_affine)[~outside].mean() == pytest.approx(5.87, abs=0.005)
    assert errors(x)[~outside].mean() == pytest.approx(2.42, abs=0.005)
