"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# The same examples in every run: a failure that comes and goes tells nobody anything.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real images by others; not part of the project, so tests that need it are skipped without."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MRSTRAIN_TEST_DATA", beside))
    if not (folder / "README.md").is_file():
        pytest.skip(f"real test data not found at {folder}; set MRSTRAIN_TEST_DATA to its folder")
    return folder


@pytest.fixture(scope="session")
def heel():
    from phantoms.anatomy import Heel

    return Heel(seed=1)


@pytest.fixture(scope="session")
def tissue_points(heel):
    """Points in soft tissue and bone, all over the heel, LPS mm."""
    points = np.random.default_rng(5).uniform([-32, -55, -45], [32, 46, 40], (6000, 3))
    return points[heel.tissue_at(points) > 0]


@pytest.fixture(scope="session")
def small_pair():
    """A heel at 1.6 mm voxels, pressed, moved and scanned again; truth known."""
    from phantoms.heel import heel_pair

    return heel_pair(seed=3, shape=(64, 72, 68), spacing_mm=1.6, load=0.6)


@pytest.fixture(scope="session")
def tiny_pair():
    """The same at 2.5 mm, where seconds count."""
    from phantoms.heel import heel_pair

    return heel_pair(seed=3, shape=(40, 46, 42), spacing_mm=2.5, load=0.6)


@pytest.fixture(scope="session")
def worker():
    """One process that runs elastix for all tests: its first use costs many seconds."""
    from dvc.worker import Worker

    with Worker(threads=1) as one:
        yield one
