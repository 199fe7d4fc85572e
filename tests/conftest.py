"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import hashlib
import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from hypothesis import settings

from dvc import threads

# The same examples in every run: a failure that comes and goes tells nobody anything.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Two workers have a core each: tests of threads ask for theirs."""
    threads.use(1)


@pytest.fixture(scope="module", autouse=True)
def _little_to_collect() -> None:
    """Each task ends with a collection, which would look at everything that pytest holds: a third of a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """Blank in `make test`; `make test-all` draws all figures as users get them."""
    from tests.pictures import blank_pictures, real_pictures

    with blank_pictures() if "not full_size" in request.config.option.markexpr else real_pictures():
        yield


@pytest.fixture
def real_pictures() -> Iterator[None]:
    """For tests that look at figures."""
    from tests.pictures import real_pictures

    with real_pictures():
        yield


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
    from phantoms import Heel

    return Heel(seed=1)


@pytest.fixture(scope="session")
def tissue_points(heel):
    """Points in soft tissue and bone, all over the heel, LPS mm."""
    points = np.random.default_rng(5).uniform([-32, -55, -45], [32, 46, 40], (6000, 3))
    return points[heel.tissue_at(points) > 0]


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Fill a folder once for all tests, whichever worker asks first; nobody may write into it afterwards."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def made(name: str, fill: Callable[[Path], None]) -> Path:
        folder, filled = shared / name, shared / f"{name}.filled"
        with FileLock(shared / f"{name}.lock"):
            if not filled.exists():
                folder.mkdir(exist_ok=True)
                fill(folder)
                filled.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def computed_once(made_once) -> Callable[[str, Callable[[], Any]], Any]:
    """Compute a value once for all tests, whichever worker asks first; each worker has a copy."""

    def computed(name: str, compute: Callable[[], Any]) -> Any:
        folder = made_once(name, lambda place: (place / "value").write_bytes(pickle.dumps(compute())))
        return pickle.loads((folder / "value").read_bytes())

    return computed


@pytest.fixture(scope="session")
def heel_pair_once(computed_once) -> Callable[..., Any]:
    """`phantoms.heel_pair`, which makes each pair once for all tests."""
    from phantoms import heel_pair

    def pair(seed: int, **given: Any) -> Any:
        name = " ".join(f"{name} {given[name]}" for name in sorted(given))
        return computed_once(f"heel {seed} {name}", lambda: heel_pair(seed, **given))

    return pair


@pytest.fixture(scope="session")
def heel_at_rest_once(computed_once) -> Callable[..., tuple[Any, Any]]:
    """A scan of a heel at rest, by its seed and voxels, SNR 25, and its true labels; made once for all tests."""
    from phantoms import Heel, heel_grid, labels_of, scan

    def made(seed: int, spacing_mm: Any) -> tuple[Any, Any]:
        heel, grid = Heel(seed), heel_grid(spacing_mm)
        return scan(heel, grid, snr=25.0, number=0), labels_of(heel, grid)

    return lambda seed, spacing_mm: computed_once(f"rest {seed} {spacing_mm}", lambda: made(seed, spacing_mm))


@pytest.fixture(scope="session")
def mesh_labels_once(computed_once) -> Callable[..., Any]:
    """`fe.mesh_labels`, which makes each mesh once for all tests."""
    from fe import mesh_labels

    def mesh(*given: Any, **more: Any) -> Any:
        asked = hashlib.sha256(pickle.dumps((given, more))).hexdigest()
        return computed_once(f"mesh {asked}", lambda: mesh_labels(*given, **more))

    return mesh


@pytest.fixture(scope="session")
def small_pair(heel_pair_once):
    """A heel at 1.6 mm voxels, pressed, moved and scanned again; truth known."""
    return heel_pair_once(3, load=0.6, shape=(64, 72, 68), spacing_mm=1.6)


@pytest.fixture(scope="session")
def tiny_pair(heel_pair_once):
    """The same at 2.3 mm, the largest voxels whose bias field is found on every other one: where seconds count."""
    return heel_pair_once(3, load=0.6, shape=(44, 50, 46), spacing_mm=2.3)


@pytest.fixture
def in_this_process() -> Iterator[None]:
    """As `tasks_run_here`, for a test."""
    from tests.processes import tasks_run_here

    with tasks_run_here():
        yield


@pytest.fixture(scope="session")
def worker():
    """One process that runs elastix for all tests: its first use costs many seconds."""
    from dvc.worker import Worker

    with Worker(threads=1) as one:
        yield one
