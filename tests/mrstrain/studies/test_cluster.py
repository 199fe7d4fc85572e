"""The cluster of a study: this machine's own, or at an address, on loopback or with TLS as docs/cluster.md says."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace

import dask
import psutil
import pytest
from distributed.protocol import ToPickle, dumps
from filelock import FileLock

from dvc.errors import InputError
from mrstrain.studies.cluster import _WORKER, StageRunner, cluster
from mrstrain.studies.run import run
from mrstrain.studies.scheduler import _refuse_unencrypted
from tests.processes import cluster_of, wait_for

DOCS = Path(__file__).resolve().parents[3] / "docs" / "cluster.md"


def test_where_one_worker_cannot_start_the_others_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For want of memory; a run told so, and then waited without end for the worker that had started."""
    begun = list[BaseProcess]()

    def made(**_: object) -> None:
        name = "Dask Worker process (from Nanny)"  # as Dask calls it
        begun.append(multiprocessing.get_context("spawn").Process(name=name, target=time.sleep, args=(600.0,)))
        begun[0].start()
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr("mrstrain.studies.cluster.LocalCluster", made)
    with pytest.raises(RuntimeError, match="Nanny failed"), cluster(lambda *_: None, [tmp_path], workers=2):
        pass
    begun[0].join(20.0)
    assert begun[0].exitcode == -signal.SIGKILL


def test_a_worker_is_called_as_dask_calls_it(tmp_path: Path) -> None:
    with cluster(lambda *_: None, [tmp_path], workers=1):
        assert any(child.name.startswith(_WORKER) for child in multiprocessing.active_children())


@pytest.mark.parametrize(
    "address", ["tcp://node1:8786", "node1:8786", "tcp://10.0.0.5:1", "tcp://[fe80::1]:1", "ucx://n:1", "ws://n:1",
                "tcp://localhost.evil.org:1", "tcp://0.0.0.0:1", "tcp://127.0.0.1.nip.io:1", ""],
)  # fmt: skip
def test_a_scheduler_on_a_network_needs_tls(address: str) -> None:
    with pytest.raises(InputError, match="without TLS") as told, cluster(lambda *_: None, [], scheduler=address):
        pass
    assert "docs/cluster.md" in str(told.value)
    assert "tls://HOST:PORT" in str(told.value)


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:8786", "127.0.0.1:1", "tcp://[::1]:1", "tcp://localhost:1", "tls://node1:8786"]
)
def test_loopback_and_tls_are_let_be(address: str) -> None:
    _refuse_unencrypted(address)


def test_a_client_without_certificates_ends_its_thread() -> None:
    """Dask's garbage ends it, and may do so while the thread of another cluster starts, which then waits for itself."""
    before = set(threading.enumerate())
    with (
        pytest.raises(InputError, match="No Dask scheduler answers"),
        cluster(lambda *_: None, [], scheduler="tls://127.0.0.1:1"),
    ):
        pass
    assert not {thread.name for thread in set(threading.enumerate()) - before if thread.name == "IO loop"}


@pytest.mark.skipif(not shutil.which("openssl"), reason="openssl is not installed")
def test_a_cluster_with_the_certificate_of_the_manual(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the manual says it, with another folder; whoever has no certificate is told, and whoever has another."""
    lines = DOCS.read_text().partition("    $ mkdir -m 700 /shared/tls")[2].partition("\n\n")[0]
    script = ("    $ mkdir -m 700 /shared/tls" + lines).replace("/shared/tls", str(tmp_path / "tls"))
    script = "\n".join(line[4:].removeprefix("$ ") for line in script.splitlines())
    subprocess.run(["bash", "-e", "-c", script], check=True, capture_output=True)
    told = subprocess.run(
        ["bash", "-c", f"source '{tmp_path}/tls/settings.sh'; env"], check=True, capture_output=True, text=True
    ).stdout
    settings = dict(line.split("=", 1) for line in told.splitlines() if line.startswith("DASK_DISTRIBUTED__COMM"))
    assert len(settings) == 8
    assert os.stat(tmp_path / "tls").st_mode & 0o077 == 0
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    keys = {name.removeprefix("DASK_").lower().replace("__", "."): value for name, value in settings.items()}
    with cluster_of(1, tmp_path, "--protocol", "tls") as (address, _):
        assert address.startswith("tls://127.0.0.1:")
        with (
            dask.config.set(keys),
            cluster(lambda *_: None, [tmp_path], scheduler=address),
        ):
            pass  # workers were found, and are fit
        with (
            pytest.raises(InputError, match="No Dask scheduler answers"),
            cluster(lambda *_: None, [tmp_path], scheduler=address),
        ):
            pass
        with (
            pytest.raises(InputError, match="No Dask scheduler answers"),
            cluster(lambda *_: None, [tmp_path], scheduler=address.replace("tls", "tcp")),
        ):
            pass


def test_settings_for_a_cluster_with_tls_leave_this_machines_own_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[object]()

    @contextmanager
    def seen(_: int) -> Iterator[tuple[None, SimpleNamespace]]:
        asked.append(dask.config.get("distributed.comm.require-encryption"))
        yield None, SimpleNamespace(run=lambda _: None, subscribe_topic=lambda *_: None)

    monkeypatch.setattr("mrstrain.studies.cluster._of_this_machine", seen)
    with dask.config.set({"distributed.comm.require-encryption": True}), cluster(lambda *_: None, [], workers=1):
        pass
    assert asked == [False]


@pytest.fixture(scope="module")
def of_this_machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StageRunner]:
    """Two workers, as a study has them on this machine."""
    with cluster(lambda *_: None, [tmp_path_factory.mktemp("runs")], workers=2) as runner:
        yield runner


def test_a_stage_whose_worker_is_killed_is_tried_once_more_when_it_is_alone(tmp_path):
    """Dask would give it to another worker at once, beside other stages, and name no cause."""
    told, again = list[tuple[str, str, float]](), ("killed", "once more", 0.0)
    with cluster(lambda *event: told.append(event), [tmp_path], workers=2) as runner:

        def kill_its_worker() -> None:
            places = runner._client.processing().items()
            (its_worker,) = (address for address, keys in places if any("killed" in key for key in keys))
            os.kill(runner._client.run(os.getpid, workers=[its_worker])[its_worker], signal.SIGKILL)

        with FileLock(tmp_path / "held"):
            with FileLock(tmp_path / "other"):
                runner.begin("killed", "mesh", {}, tmp_path / "held", gib=1.5)
                runner.begin("beside", "mesh", {}, tmp_path / "other")
                wait_for(lambda: {name for name, *_ in told} == {"killed", "beside"})
                kill_its_worker()
                ended = ThreadPoolExecutor(1).submit(runner.next)
                wait_for(lambda: runner._died)
            assert ended.result(timeout=300)[0] == "beside"
            assert again not in told
            ended = ThreadPoolExecutor(1).submit(runner.next)
            wait_for(lambda: again in told)
            kill_its_worker()
            name, outcome, _ = ended.result(timeout=300)
    assert name == "killed"
    assert outcome.startswith("Its worker process died: the system ended it, most often for lack of memory")
    assert outcome.endswith(
        "A second attempt, with no other stage running, failed too; its estimated memory need is 1.5 GiB."
    )


@pytest.mark.full_size
def test_stages_that_waited_for_a_worker_that_is_killed_go_to_another(tmp_path):
    told = list[tuple[str, str, float]]()
    with cluster(lambda *event: told.append(event), [tmp_path], workers=2) as runner:
        with FileLock(tmp_path / "held"):
            for name in ("first", "second"):
                runner.begin(name, "mesh", {}, tmp_path / "held")
            wait_for(lambda: {name for name, *_ in told} == {"first", "second"})
            for number in range(6):
                runner.begin(f"waits {number}", "mesh", {}, tmp_path / f"lock {number}")
            (its_worker,) = (
                address for address, keys in runner._client.processing().items() if any("first" in key for key in keys)
            )
            os.kill(runner._client.run(os.getpid, workers=[its_worker])[its_worker], signal.SIGKILL)
            with ThreadPoolExecutor(1) as beside:
                ended = beside.submit(lambda: [runner.next()[0] for _ in range(6)])
                assert sorted(ended.result(timeout=300)) == [f"waits {number}" for number in range(6)]
            assert [name for name, what, _ in told if what == "once more"] == []
        assert [runner.next()[0] for _ in range(2)] == ["second", "first"]
    assert [name for name, what, _ in told if what == "once more"] == ["first"]


def test_a_stage_leaves_nothing_in_the_memory_of_its_worker(images, tmp_path):
    """A worker that ran stages itself held 0.3 to 0.6 GiB of modules and freed arrays to the end of the study."""
    with cluster(lambda *_: None, [tmp_path], workers=1) as runner:
        runner.begin(
            "mesh", "mesh", {"labels": images / "missing.nii.gz", "out": tmp_path / "m.vtu"}, tmp_path / "lock"
        )
        assert "missing.nii.gz" in runner.next()[1]
        (loaded,) = runner._client.run(lambda: {*sys.modules}).values()
    assert "mrstrain.studies.stages" in loaded
    assert not loaded & {"fe", "numba", "scipy.ndimage", "SimpleITK", "matplotlib", "vtk", "mrstrain.models.mesh"}


@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
def test_temporary_files_of_workers_are_removed(tmp_path, monkeypatch, error):
    """And those of a stage that is ended with its worker, which cannot remove them."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = os.environ.get("TMPDIR")
    with pytest.raises(error) if error else nullcontext(), cluster(lambda *_: None, [], workers=1) as runner:
        (kept,) = runner._client.run(tempfile.mkdtemp).values()
        (folder,) = tmp_path.iterdir()
        assert folder in Path(kept).parents
        if error is not None:
            raise error
    assert list(tmp_path.iterdir()) == []
    assert os.environ.get("TMPDIR") == before


def test_freed_arrays_serve_the_next_in_a_worker(of_this_machine):
    kept = of_this_machine._client.submit(os.environ.get, "MALLOC_TRIM_THRESHOLD_", "freed arrays serve the next")
    assert kept.result(timeout=300) == "freed arrays serve the next"


def test_memory_that_a_worker_lacks_for_a_message_is_no_traceback(tmp_path, capfd):
    """Its stage tells that the memory ran out; Dask told of each message, such as that the worker lives."""

    def lacks_memory() -> None:
        class TooLarge:
            def __reduce__(self) -> str:
                raise MemoryError("Unable to allocate internal buffer.")

        with suppress(MemoryError):
            dumps(ToPickle(TooLarge()))

    with cluster(lambda *_: None, [tmp_path], workers=1) as runner:
        runner._client.run(lacks_memory)
        runner._client.run_on_scheduler(lacks_memory)
        runner._client.run(lacks_memory, nanny=True)
    told = "".join(capfd.readouterr())
    assert "Traceback" not in told, told


def test_what_runs_a_study_is_reached_from_this_machine_alone(of_this_machine):
    assert of_this_machine._client.nthreads()
    sockets = []
    for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
        with suppress(psutil.NoSuchProcess):  # one of another test, which has just ended
            sockets += process.net_connections("tcp")
    listening = [one.laddr.ip for one in sockets if one.status == psutil.CONN_LISTEN]
    assert len(listening) >= 5  # the scheduler, its page, and at least a nanny, a worker, and the worker's page
    assert set(listening) == {"127.0.0.1"}


def test_a_scheduler_that_is_not_there(images, tmp_path, monkeypatch):
    monkeypatch.setattr("mrstrain.studies.scheduler._CONNECT_S", 1.0)
    study = tmp_path / "study"
    shutil.copytree(images, study)
    with pytest.raises(InputError, match="No Dask scheduler"):
        run(study, scheduler="tcp://127.0.0.1:1")
