"""What the machine does to a run: full disks, memory that runs out, folders that go, clocks that are set back."""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import Future
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from filelock import FileLock

from dvc.errors import InputError, WorkerError
from dvc.memory import is_lack_of_memory
from dvc.threads import usable_cores
from mrstrain.records.progress import NOTE
from mrstrain.studies import cluster, ledger, stages
from mrstrain.studies.cluster import StageRunner, _Call
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.pipeline import Pipeline
from mrstrain.studies.run import _log
from mrstrain.studies.stage_process import outcome_of
from mrstrain.studies.stages import StageResult
from tests.mrstrain.studies import test_pipeline
from tests.mrstrain.studies.test_pipeline import ALL, Here, ran, stages_in
from tests.processes import ended_process, is_gone, wait_for

if sys.platform != "win32":
    import resource

ROOT = Path(cluster.__file__).resolve().parents[2]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
@pytest.mark.parametrize("stage", ALL)
def test_a_stage_whose_record_a_disk_does_not_take_is_named_and_made_again(folder, monkeypatch, stage, code):
    rename = os.replace

    def refusing(source: Path, target: Path) -> None:
        if Path(target).name == f"{stage}.json":
            raise OSError(code, os.strerror(code))
        rename(source, target)

    with monkeypatch.context() as full:
        full.setattr(os, "replace", refusing)
        _, outcomes, told = ran(folder)
    assert outcomes[stage].status == "FAILED"
    assert f"{os.strerror(code)}). Check" in outcomes[stage].reason
    assert any(line.startswith(f"{stage}: FAILED") and os.strerror(code) in line for line in told)
    assert not list((folder / "results").rglob(".*partial*"))
    again, outcomes, _ = ran(folder)
    assert again[0] == stage
    assert all(one.complete for one in outcomes.values())


def test_a_log_that_a_full_disk_does_not_take_stops_nothing(tmp_path):
    _log(tmp_path / "gone" / "study.log", "mesh: done")


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "/tmp/x"), "/tmp/x: No space left on device. Free disk"),
        (OSError(errno.EROFS, "Read-only file system"), "Read-only file system. Free disk space or change"),
        (InputError("Load1.nii.gz: damaged."), "Load1.nii.gz: damaged."),
        (KeyError("fat"), "This is an error in mrstrain"),
    ],
)
def test_a_failure_of_the_machine_is_no_error_in_mrstrain(tmp_path, monkeypatch, failure, told):
    assert told in ended_by(failure, tmp_path, monkeypatch)


def ended_by(failure: Exception, folder: Path, monkeypatch: pytest.MonkeyPatch) -> object:
    """What the process of a stage returns that raises an error."""

    def failing(tell: object) -> None:
        raise failure

    monkeypatch.setattr(stages, "mesh", failing)
    return outcome_of("mesh", {}, str(folder / "lock"), lambda *_: None, alone=False)


@pytest.mark.parametrize(
    "lack",
    [
        MemoryError("Unable to allocate 40 GiB"),
        ImportError("/lib/_core.so: failed to map segment from shared object"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),
    ],
)
def test_memory_that_runs_out_counts_as_a_process_that_died(tmp_path, monkeypatch, lack):
    """Each of these ended a stage of a study whose address space was limited."""
    ended = ended_by(lack, tmp_path, monkeypatch)
    assert isinstance(ended, WorkerError)
    assert f"The memory ran out ({str(lack).removeprefix('/lib/')})" in str(ended)
    assert "fewer --workers" in str(ended)


def test_an_error_in_the_handling_of_lack_of_memory_is_lack_of_memory():
    """As that of Dask where it cannot start a worker; one that is raised "from None" stands alone."""
    first, later, last = RuntimeError("can't start new thread"), AssertionError("init"), OSError("not started")
    later.__context__, last.__cause__ = first, later
    assert is_lack_of_memory(last)
    later.__suppress_context__ = True
    assert not is_lack_of_memory(last)


@pytest.mark.parametrize("alone", [False, True])
def test_a_second_attempt_counts_on_one_core(tmp_path, monkeypatch, alone):
    """A comparison, which starts a process for each core, then needs two thirds of its memory on two."""
    cores = list[int]()
    monkeypatch.setattr(stages, "compare", lambda tell: cores.append(usable_cores()))
    outcome_of("compare", {}, str(tmp_path / "lock"), lambda *_: None, alone=alone)
    assert cores == [1 if alone else usable_cores()]


@pytest.mark.full_size
@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
@pytest.mark.parametrize(("mib", "ends"), [(700, {2}), (900, {2}), (1000, {1, 2}), (1300, {0})])
def test_a_study_without_enough_memory_names_it_and_ends(images, tmp_path, mib, ends):
    """Address space is lacking for the command, then for its workers, for some of them, then for nothing.

    Its libraries alone take 850 MiB. With some 50 MiB less, OpenBLAS ends it with a message and status of its own.
    Dask and loky may print tracebacks of their own where they get no thread; none comes from mrstrain.
    """
    shutil.copytree(images, tmp_path / "study")
    told = subprocess.run(
        [sys.executable, "-m", "mrstrain", "run", str(tmp_path / "study"), "--workers", "2"],
        preexec_fn=partial(resource.setrlimit, resource.RLIMIT_AS, (mib << 20, mib << 20)),
        capture_output=True, text=True, check=False, timeout=500,
    )  # fmt: skip
    said = told.stdout + told.stderr
    assert told.returncode in ends
    if not told.returncode:
        return
    assert "The memory ran out" in said
    assert "fewer --workers" in said.replace("\n", " ")
    assert "error in mrstrain" not in said
    assert not re.search(rf'File "{re.escape(str(ROOT))}/(?:dvc|fe|mrstrain|phantoms|validate)/', said), said


class Machine:
    """A client of Dask on which each stage ends at once, the hungry ones dead so many times."""

    status = "running"

    def __init__(self, **hungry: int) -> None:
        self.hungry, self.begun = hungry, list[str]()

    def subscribe_topic(self, *_: object) -> None:
        pass

    def submit(self, _function: object, _topic: str, call: _Call, **_: object) -> Future:
        self.begun.append(call.name)
        self.hungry[call.name] = self.hungry.get(call.name, 0) - 1
        future = Future()
        future.status = "finished"
        dies = self.hungry[call.name] >= 0
        future.set_result((WorkerError("It died.") if dies else StageResult((f"{call.name} done",)), 1.0))
        return future

    def nthreads(self) -> dict[str, int]:
        return {"tcp://a": 1, "tcp://b": 1}


@pytest.mark.parametrize("deaths", [1, 2])
def test_a_stage_whose_process_died_is_tried_once_more_when_it_is_alone(tmp_path, deaths):
    machine = Machine(big=deaths)
    runner = StageRunner(machine, lambda *_: None)
    for name in ("big", "small", "other"):
        runner.begin(name, "mesh", {}, tmp_path / "lock", gib=2.34)
    ended = {}
    while runner.busy:
        name, outcome, _ = runner.next()
        ended[name] = outcome
        if name == "small":
            runner.begin("next", "mesh", {}, tmp_path / "lock")
    assert machine.begun == ["big", "small", "other", "next", "big"]
    assert list(ended) == ["small", "other", "next", "big"]
    expected = (
        "It died. A second attempt, with no other stage running, failed too; its estimated memory need is 2.3 GiB."
        if deaths == 2
        else "This was computed at the second attempt. It died."
    )
    assert expected in (ended["big"] if deaths == 2 else ended["big"].lines)


def test_a_stage_waits_for_whichever_worker_is_free_first_and_the_longest_goes_first(tmp_path, monkeypatch):
    """Dask gave stages to a worker that was busy for a minute, and the other had nothing to do."""
    sent = list[str]()
    futures = list[Future]()

    def submit(_function: object, _topic: str, call: _Call, **_: object) -> Future:
        sent.append(call.name)
        futures.append(Future())
        futures[-1].status = "finished"
        return futures[-1]

    machine = Machine()
    monkeypatch.setattr(machine, "submit", submit)
    runner = StageRunner(machine, lambda *_: None)
    for name, to_end_s in (("long", 9.0), ("b", 5.0), ("c", 3.0), ("d", 4.0)):
        runner.begin(name, "mesh", {}, tmp_path / "lock", to_end_s)
    assert sent == ["long", "b"]  # there are two workers
    futures[1].set_result((StageResult(()), 1.0))
    assert runner.next()[0] == "b"
    runner.begin("e", "mesh", {}, tmp_path / "lock", 1.0)
    assert sent[2:] == ["d"]
    futures[2].set_result((StageResult(()), 1.0))
    assert runner.next()[0] == "d"
    futures[0].set_result((StageResult(()), 1.0))
    assert runner.next()[0] == "long"
    assert sent[3:] == ["c", "e"]
    assert runner.busy


def test_stages_that_wait_for_a_scheduler_that_has_stopped_fail_one_by_one(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "_LOOK_EVERY_S", 0.01)
    machine = Machine()
    monkeypatch.setattr(machine, "submit", lambda *_, **__: Future())  # which never ends
    runner = StageRunner(machine, lambda *_: None)
    for name in ("a", "b", "c", "d"):
        runner.begin(name, "mesh", {}, tmp_path / "lock")
    machine.status = "closed"  # as Dask's client is, some seconds after its scheduler is gone
    ended = [runner.next() for _ in range(4)]
    assert sorted(name for name, _, _ in ended) == ["a", "b", "c", "d"]
    assert {outcome for _, outcome, _ in ended} == {"The scheduler, or every worker, has stopped."}
    assert not runner.busy


def test_a_stage_that_hangs_is_named_then_ended_and_the_others_finish(tmp_path, monkeypatch):
    """It waits for a lock that is never free, in a worker that runs the next stage after that."""
    told = list[tuple[str, str, float]]()
    monkeypatch.setattr(cluster, "_LOOK_EVERY_S", 0.2)
    monkeypatch.setattr(cluster, "_SILENT_S", 4.0)
    monkeypatch.setattr(cluster, "_NAME_EVERY_S", 2.0)
    with (
        FileLock(tmp_path / "held"),
        cluster.cluster(lambda *event: told.append(event), [tmp_path], workers=1) as runner,
    ):
        runner.begin("hangs", "mesh", {}, tmp_path / "held", 0.01)
        runner.begin("next", "no_stage", {}, tmp_path / "lock", 0.0)
        wait_for(lambda: told)
        assert told == [("hangs", "begun", 0.0)]
        (worker,) = runner._client.nthreads()
        (below,) = runner._client.run(lambda: subprocess.Popen(["sleep", "600"]).pid).values()
        # Without it, a machine that wakes up, and a clock that is set, end every worker.
        assert runner._client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.worker_ttl) is None
        name, outcome, seconds = runner.next()
        assert (name, round(seconds)) == ("hangs", 4)
        assert "made no progress for 4 s and was stopped" in outcome
        assert "Run the study again" in outcome
        ((_, sentence, _),) = [event for event in told if event[0] == NOTE]
        assert sentence.startswith("hangs has made no progress for 2 s. After 4 s it is stopped; the others continue")
        name, outcome, _ = runner.next()
        assert name == "next"
        assert "has no attribute 'no_stage'" in outcome
        assert worker not in runner._client.nthreads()
        wait_for(lambda: is_gone(below))
        assert not runner.busy


@pytest.mark.parametrize(("to_end_s", "limit_s"), [(0.0, 3600.0), (300.0, 3600.0), (5000.0, 50_000.0)])
def test_a_long_stage_may_be_silent_for_longer(to_end_s, limit_s):
    """By what the study is expected to take from it on: a machine that is ten times as slow loses nothing."""
    assert _Call("mesh", "mesh", {}, "lock", to_end_s, 0.0).may_be_silent_s == limit_s


def test_a_stage_that_tells_something_now_and_then_does_not_hang(tmp_path, monkeypatch):
    runner = StageRunner(Machine(), lambda *_: None)
    monkeypatch.setattr(runner._client, "submit", lambda *_, **__: Future())
    runner.begin("slow", "mesh", {}, tmp_path / "lock")
    assert runner._hung() is None  # it has not begun
    for n in range(3):
        runner._tell("slow", "registering", 0.1 * n)
        assert not any(runner._hung() for _ in range(3600))
    runner._tell("slow", "registering", 0.2)  # as a worker tells of a process that hangs
    assert runner._hung() is not None


def test_a_worker_without_memory_for_a_stage_counts_as_a_process_that_died(tmp_path, monkeypatch):
    future = Future()
    future.status = "error"
    future.set_exception(RuntimeError("can't start new thread"))
    runner = StageRunner(Machine(), lambda *_: None)
    monkeypatch.setattr(runner._client, "submit", lambda *_, **__: future)
    runner.begin("mesh", "mesh", {}, tmp_path / "lock")
    _, outcome, _ = runner.next()
    assert outcome.startswith("The memory ran out (can't start new thread). Free memory")
    assert "A second attempt, with no other stage running, failed too" in outcome


def test_a_stage_whose_end_no_thread_can_tell_has_ended(tmp_path, monkeypatch):
    """Dask starts a thread for it, and where memory is short there is none: a run waited for ever."""
    monkeypatch.setattr(Future, "add_done_callback", lambda *_: None)
    monkeypatch.setattr(cluster, "_LOOK_EVERY_S", 0.01)
    machine = Machine(big=1)
    runner = StageRunner(machine, lambda *_: None)
    runner.begin("big", "mesh", {}, tmp_path / "lock")
    runner.begin("small", "mesh", {}, tmp_path / "lock")
    assert [runner.next()[0] for _ in range(2)] == ["small", "big"]
    assert not runner.busy


@pytest.mark.full_size
def test_dask_keeps_no_record_of_stages_that_have_ended(tmp_path):
    """Of each it kept 24 KiB in this process and 7 KiB in the worker, for a thousand steps of each."""
    with cluster.cluster(lambda *_: None, [tmp_path], workers=1) as runner:
        for number in range(15):
            runner.begin(f"mesh {number}", "no_stage", {}, tmp_path / "lock")
            runner.next()
        there = runner._client.run_on_scheduler(lambda dask_scheduler: [*dask_scheduler.transition_log])
        (at_work,) = runner._client.run(lambda dask_worker: len(dask_worker.state.stimulus_log)).values()
    assert 0 < len(there) <= 10
    assert 0 < at_work <= 10


@pytest.mark.parametrize("starts", [True, False])
def test_a_worker_that_takes_long_to_start_is_waited_for(tmp_path, monkeypatch, starts):
    """On a machine with too much to do it takes minutes; a worker that has no process is not waited for as long."""
    monkeypatch.setattr(cluster, "_LOOK_EVERY_S", 0.01)
    monkeypatch.setattr(cluster, "_LOST_S", 0.05)
    waiting, machine = Future(), Machine()
    waiting.status = "pending"
    monkeypatch.setattr(machine, "submit", lambda *_, **__: waiting)
    looks = iter(range(50))

    def nthreads() -> dict[str, int]:
        time.sleep(0.01)
        if next(looks) == 20:  # after .2 s
            waiting.status = "finished"
            waiting.set_result((StageResult(("meshed",)), 1.0))
        return {}

    monkeypatch.setattr(machine, "nthreads", nthreads)
    nanny = SimpleNamespace(pid=os.getpid() if starts else ended_process())
    runner = StageRunner(machine, lambda *_: None, SimpleNamespace(workers={0: nanny}))
    runner.begin("mesh", "mesh", {}, tmp_path / "lock")
    _, outcome, _ = runner.next()
    assert outcome == (StageResult(("meshed",)) if starts else "The scheduler, or every worker, has stopped.")


def test_results_that_are_removed_under_a_run_are_not_recorded(folder, monkeypatch):
    class Removing(Here):
        def next(self) -> tuple[str, StageResult | str, float]:
            ended = super().next()
            if ended[0] == "simulate b":
                shutil.rmtree(folder / "results")
            return ended

    with monkeypatch.context() as removed:
        removed.setattr(test_pipeline, "Here", Removing)
        _, outcomes, _ = ran(folder, failing=("compare",))  # as it finds nothing to read
    assert outcomes["simulate b"].status == "FAILED"
    assert "was removed while the study ran" in outcomes["simulate b"].reason
    assert ran(folder)[0] == ALL
    assert ran(folder)[0] == []


def test_a_reason_that_is_damaged_is_told_as_it_is(folder):
    ran(folder, failing=("register a",))
    (folder / "results" / ".study" / "register a.failed.txt").write_bytes(b"It \xff\xfe broke.")
    pipeline = Pipeline(stages_in(folder), Ledger(folder / "results", folder), only=("mesh",))
    pipeline.settle()
    assert "broke" in pipeline.outcomes["register a"].reason
    assert ran(folder)[0] == ["register a", "compare"]


def test_a_clock_that_is_set_back_makes_nothing_anew_and_refuses_nothing(folder, monkeypatch):
    def at(year: int) -> None:
        class Clock(datetime):
            @classmethod
            def now(cls, tz: object = None) -> datetime:
                return datetime(year, 1, 1, tzinfo=UTC)

        monkeypatch.setattr(ledger, "datetime", Clock)
        monkeypatch.setattr(time, "time", lambda: datetime(year, 1, 1, tzinfo=UTC).timestamp())

    at(2040)
    assert ran(folder)[0] == ALL
    for file in (folder / "results").iterdir():
        os.utime(file, (4e9, 4e9)) if file.is_file() else None
    at(2001)
    assert ran(folder)[0] == []
    (folder / "a.txt").write_text("z")
    os.utime(folder / "a.txt", (1.0, 1.0))
    assert ran(folder)[0] == ["register a", "compare"]
    at(2040)
    assert ran(folder)[0] == []
