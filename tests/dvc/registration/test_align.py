"""The search for a bone's place, where a fit from the header's would be trapped."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from dvc.images.image import Grid, Image, Mask
from dvc.registration import align as align_module
from dvc.registration.align import align


def test_a_shaft_that_slid_along_itself_is_found() -> None:
    """A fit from the header's place ends 29 mm off, where the shaft looks right as well (correlation 0.97)."""
    grid = Grid((48, 48, 110), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    random = np.random.default_rng(0)
    texture = gaussian_filter(random.standard_normal((48, 48, 150)), 3.0)
    texture /= texture.std()
    i, j, _ = np.indices((48, 48, 150))
    shaft = np.hypot(i - 23.5, j - 23.5) < 9.0
    scene = np.where(shaft, 60.0, 260.0) * (1.0 + 0.1 * texture)

    def scan(start: int) -> Image:
        return Image(grid, (scene[..., start : start + 110] + 4.0 * random.standard_normal(grid.shape)))

    inside = shaft[..., :110].copy()
    inside[..., :40], inside[..., 70:] = False, False
    found = align(scan(20), scan(0), Mask(grid, inside), "bone", 1)
    np.testing.assert_allclose(found.bone_shift_mm, (0.0, 0.0, 20.0), atol=0.2)


def test_a_bone_at_the_scans_end_does_not_meet_itself_on_the_other_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """The transforms are so small that the template just fits beside the scene; twice the room changes no score."""
    grid = Grid((40, 36, 32), np.full(3, 2.0), np.zeros(3))
    values = gaussian_filter(np.random.default_rng(3).normal(size=grid.shape), 4.0).astype(np.float32)
    inside = np.zeros(grid.shape, dtype=bool)
    inside[1:12, 2:20, 20:31] = True
    cut = slice(3, None), slice(None), slice(0, 29)  # a part of the bone is not shown
    image, bone, loaded = Image(grid, values), Mask(grid, inside), Image(grid.part(cut), values[cut])
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.2, -0.3, 0.1]]).as_matrix()
    scored = align_module._scored(image, loaded, bone, list(turns))
    monkeypatch.setattr(align_module.fft, "next_fast_len", lambda size, real: 2 * size)
    again = align_module._scored(image, loaded, bone, list(turns))
    for (score, motion), (other, same) in zip(scored, again, strict=True):
        assert abs(score - other) < 1e-5
        np.testing.assert_allclose(motion.translation_mm, same.translation_mm, atol=1e-9)
    assert scored[0][0] > 0.5
