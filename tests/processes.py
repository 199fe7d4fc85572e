"""Processes beside the test's own: doing without them, waiting for what they do, and a cluster of them."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL, Popen
from threading import Lock
from typing import Any

import psutil
import pytest
from filelock import FileLock, Timeout

from dvc.worker import Worker


def under_way(records: Path, stage: str) -> bool:
    """Whether a worker holds the stage's lock, and the stage has no record yet."""
    lock = records / f"{stage}.lock"
    if not lock.is_file():
        return False
    try:
        with FileLock(lock, timeout=0):
            return False
    except Timeout:
        return not (records / f"{stage}.json").exists()


def wait_for(condition: Callable[[], bool], process: Popen | None = None, limit_s: float = 300.0) -> None:
    """Wait until a condition holds, while a process runs, if one is given."""
    began = time.monotonic()
    while not condition():
        assert process is None or process.poll() is None, "it ended before"
        assert time.monotonic() - began < limit_s, "it took too long"
        time.sleep(0.2 if process else 0.02)


def is_gone(process: int) -> bool:
    """Whether a process has ended; what is left of it may wait for its parent, which need not look at once."""
    try:
        return psutil.Process(process).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def ended_process() -> int:
    """The number of a process that has ended."""
    with Popen([sys.executable, "-c", ""]) as process:
        return process.pid


@contextmanager
def tasks_run_here() -> Iterator[None]:
    """Tasks of workers run in this process, one at a time: one of their own costs two seconds of imports for each."""
    here = Lock()

    def run(_: Worker, what: str, task: Callable[..., Any], *given: Any, **_watch: Any) -> Any:
        with here:
            return task(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Worker, "run", run)
        patch.setattr(Worker, "start", lambda *_: None)
        yield


class _Client:
    """A client of Dask that runs each stage when it is given; stages take it for their worker, too."""

    status = "running"

    def subscribe_topic(self, _topic: str, handler: Callable[[tuple[float, Any]], None]) -> None:
        self._handler = handler

    def log_event(self, _topic: str, event: object) -> None:
        self._handler((0.0, event))

    def submit(self, function: Callable[..., Any], *given: Any, **_: Any) -> Future[Any]:
        future = Future[Any]()
        future.status = "finished"  # type: ignore[attr-defined]
        future.set_result(function(*given))
        return future

    def nthreads(self) -> dict[str, int]:
        return {"here": 1}


@contextmanager
def stages_run_here() -> Iterator[None]:
    """Stages of studies and their tasks run in this process: a cluster costs ten seconds of imports in each run."""
    from mrstrain.studies import cluster
    from mrstrain.studies.stage_process import outcome_of

    @contextmanager
    def here(watch: Callable[[str, str, float], None], *_: object, **__: object) -> Iterator[cluster.StageRunner]:
        with pytest.MonkeyPatch.context() as patch:
            client = _Client()
            patch.setattr(cluster, "get_worker", lambda: client)
            patch.setattr(cluster, "run_stage", lambda _name, *given, **how: outcome_of(*given, **how))
            yield cluster.StageRunner(client, watch)  # type: ignore[arg-type]

    with tasks_run_here(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "cluster", here)
        yield


@contextmanager
def tasks_run_in(one: Worker) -> Iterator[None]:
    """Tasks of all workers run in the process of one: the first use of elastix takes ten seconds in each."""
    run = Worker.run

    def there(_: Worker, *given: Any, **watch: Any) -> Any:
        return run(one, *given, **watch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Worker, "run", there)
        patch.setattr(Worker, "start", lambda *_: None)
        yield


@contextmanager
def cluster_of(count: int, folder: Path, *options: str) -> Iterator[tuple[str, list[Popen]]]:
    """A Dask scheduler on loopback, by its address, and so many workers of one thread each, ended with the block.

    ``options`` are the scheduler's own.
    """
    environment = os.environ | {"DASK_DISTRIBUTED__WORKER__DAEMON": "False"}
    file = folder / "scheduler.json"

    def started(command: str, *given: str) -> Popen:
        asked = [sys.executable, "-m", f"distributed.cli.{command}", "--dashboard-address", "127.0.0.1:0", *given]
        return Popen([*asked, "--scheduler-file", str(file)], env=environment, stdout=DEVNULL, stderr=DEVNULL)

    scheduler = started("dask_scheduler", "--host", "127.0.0.1", "--port", "0", *options)
    places = [("--local-directory", str(folder / str(n))) for n in range(count)]
    workers = [started("dask_worker", "--no-nanny", "--nthreads", "1", *place) for place in places]
    try:
        wait_for(file.is_file, scheduler)
        yield json.loads(file.read_text())["address"], workers
    finally:
        for one in (*workers, scheduler):
            one.kill()
            one.wait()
