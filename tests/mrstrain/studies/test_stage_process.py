"""A stage in a process of its own: what it tells, and what remains of it when that process dies."""

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest
from filelock import FileLock

from dvc.errors import WorkerError
from dvc.worker import Worker, in_this_process
from mrstrain.studies import stages
from mrstrain.studies.stage_process import run_stage
from mrstrain.studies.stages import StageResult, Tell
from tests.processes import wait_for


def test_progress_is_told_beside_the_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def mesh(tell: Tell) -> StageResult:
        tell("meshing", 0.25)
        tell("meshing", 0.5)  # too soon to be told
        tell("meshing", 1.0)
        return StageResult(("done",))

    def here(_: Worker, _what: str, task: Callable[..., object], *given: object, watch: Callable[[], None]) -> object:
        watch()  # nothing is known yet
        result = task(*given)
        watch()
        return result

    told = list[tuple[str, float]]()
    monkeypatch.setattr(stages, "mesh", mesh)
    monkeypatch.setattr(Worker, "run", here)
    outcome = run_stage("mesh", "mesh", {}, str(tmp_path / "lock"), lambda *news: told.append(news))
    assert outcome == StageResult(("done",))
    assert told == [("meshing", 1.0)]


def test_a_stage_whose_process_is_killed_tells_that_it_died(tmp_path: Path) -> None:
    here = psutil.Process()

    def waiting() -> list[psutil.Process]:
        return [one for one in here.children() if "_Child" in " ".join(one.cmdline())]

    with FileLock(tmp_path / "lock"), ThreadPoolExecutor(1) as beside:  # it waits for the lock
        before = {*waiting()}  # other tests may keep a worker
        ended = beside.submit(run_stage, "mesh", "mesh", {}, str(tmp_path / "lock"), lambda *_: None)
        wait_for(lambda: {*waiting()} - before)
        time.sleep(1.0)
        for process in {*waiting()} - before:
            process.kill()
        outcome = ended.result(timeout=60)
    assert isinstance(outcome, WorkerError)
    assert str(outcome).startswith("The process running mesh died")


def test_tasks_of_a_stage_run_in_its_process() -> None:
    told = list[str]()
    with in_this_process(), Worker(threads=1) as worker:
        assert worker.run("adding", sum, [1, 2], watch=lambda: told.append("watched")) == 3
        assert worker.run("asking", os.getpid) == os.getpid()
        worker.run("sleeping", time.sleep, 1.2, watch=lambda: told.append("slept"))
        with pytest.raises(ZeroDivisionError):
            worker.run("dividing", divmod, 1, 0)
        with pytest.raises(WorkerError, match="The memory ran out while asking for much"):
            worker.run("asking for much", _much)
    assert set(told) == {"slept"}
    with Worker(threads=1) as worker:
        assert worker.run("asking", os.getpid) != os.getpid()


def _much() -> None:
    raise MemoryError("Unable to allocate 40 GiB")
