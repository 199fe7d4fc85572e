"""The Dask cluster on which stages run: the cores of this machine by default, or an existing cluster."""

import logging
import multiprocessing
import os
import queue
import signal
import tempfile
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import dask
import psutil
from distributed import Client, Future, KilledWorker, LocalCluster, Nanny, get_worker

from dvc.errors import WorkerError
from dvc.memory import is_lack_of_memory
from dvc.threads import usable_cores
from mrstrain.measurement import guard
from mrstrain.records.outcome import lack_of_machine
from mrstrain.records.progress import NOTE, OnProgress, duration
from mrstrain.studies.scheduler import at_address
from mrstrain.studies.stage_process import Outcome, run_stage
from mrstrain.studies.stages import StageResult

_MOST_LOST = 3
_WORKER = "Dask Worker process"  # begins the name of the process of a worker
_TRIED = "This was computed at the second attempt."
# What ends by itself: removes the semaphores of processes that are gone; ends a user's command with who asked for it.
_SPARED = "resource_tracker", guard.__file__
_NOTHING_LOGGED = logging.CRITICAL + 1  # by Dask, as of each message that there is no memory for: stages tell of theirs
_LOOK_EVERY_S, _LOST_S = 1.0, 120.0  # an interrupt may be seen only at the next look
_STARTS_S = 900.0  # for a worker whose process starts: over two minutes where ten others want the same core
# A stage hangs that tells nothing new for this long, and for this many times what the rest of its study should take.
_SILENT_S, _SILENT_TIMES = 3600.0, 10.0
_NAME_EVERY_S = 600.0  # a stage that tells nothing new
_SETTINGS = {
    "distributed.worker.daemon": False,  # a stage starts its own processes
    "distributed.scheduler.allowed-failures": 0,  # a stage that ends a worker is tried once more here, not by Dask
    # Workers that were not heard of for minutes by the clock would be ended: on a machine that slept, on one that has
    # too much to do, and when the clock is set. A stage that hangs is noticed by what it tells.
    "distributed.scheduler.worker-ttl": None,
    "distributed.deploy.lost-worker-timeout": "15 minutes",  # for its process to start anew: `_STARTS_S`
    "distributed.worker.memory.terminate": False,  # memory is used in those processes
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.profile.enabled": False,
    # Dask makes glibc return every freed array to the system, which clears its pages again for the next one. That took
    # a fifth of the processor time of a study.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
    # Semaphores of a worker that was ended are removed by loky's tracker, which need not tell of it.
    "distributed.nanny.pre-spawn-environ.PYTHONWARNINGS": "ignore:resource_tracker:UserWarning",
    # It keeps an hour of its own memory and load, and a thousand steps of stages that ended: nobody looks at them.
    "distributed.admin.system-monitor.log-length": 10,
    "distributed.admin.low-level-log-length": 10,
    "distributed.diagnostics.computations.max-history": 1,
    "logging.distributed": "error",
}


@dataclass(frozen=True, slots=True)
class _Call:
    """A stage as a worker gets it."""

    name: str
    function: str
    arguments: dict[str, Any]
    lock: str
    to_end_s: float  # expected, from its start to the end of the study
    gib: float  # of memory, expected; 0 if not known
    died: str = ""  # how a process of it died at the first attempt
    lost: int = 0  # workers that died while it waited for them

    @property
    def may_be_silent_s(self) -> float:
        """How long it may tell nothing new before it is taken to hang, seconds."""
        return max(_SILENT_S, _SILENT_TIMES * self.to_end_s)


class StageRunner:
    """Runs several stages at the same time; made by `cluster`."""

    def __init__(self, client: Client, watch: OnProgress, local: LocalCluster | None = None) -> None:
        self._client, self._watch = client, watch
        self._local = local  # workers for this run alone
        self._topic = f"mrstrain-{uuid.uuid4().hex}"
        self._waiting: list[_Call] = []  # for a worker that is free
        self._under_way: dict[Future[Any], _Call] = {}
        self._died: list[_Call] = []  # to be tried once more
        self._finished: queue.Queue[Future[Any]] = queue.Queue()
        # Of each stage that has begun, for how long no news came while it was looked for; not while the machine sleeps.
        self._silent_s: dict[str, float] = {}
        self._told: dict[str, tuple[str, float]] = {}  # the latest
        client.subscribe_topic(self._topic, lambda event: self._tell(*event[1]))

    def _tell(self, name: str, what: str, fraction: float) -> None:
        if self._told.get(name) != (what, fraction):  # else its worker lives, but it may not go on
            self._silent_s[name] = 0.0
        self._told[name] = what, fraction
        self._watch(name, what, fraction)

    def begin(
        self, name: str, function: str, arguments: Mapping[str, Any], lock: Path, to_end_s: float = 0.0,
        gib: float = 0.0,
    ) -> None:  # fmt: skip
        """Queue a stage; it starts when a worker and its lock are free.

        Of the waiting stages, that one is first from whose start the study is expected to take the most seconds. A
        stage that fails for lack of memory tells what it is expected to need.
        """
        self._waiting.append(_Call(name, function, dict(arguments), str(lock), to_end_s, gib))
        self._send()

    def _send(self) -> None:
        """Send waiting stages to free workers; to one that may still come, if there is none.

        Dask gives a stage to a worker at once, even to one that is busy for minutes while another soon has no work.
        """
        if self._client.status != "running":
            return
        slots = sum(self._client.nthreads().values()) or 1
        while self._waiting and len(self._under_way) < slots:
            call = max(self._waiting, key=lambda one: one.to_end_s)
            self._waiting.remove(call)
            self._submit(call)

    def _submit(self, call: _Call) -> None:
        key = f"{call.name.replace(' ', '-')}-{uuid.uuid4().hex}"
        future = self._client.submit(_run, self._topic, call, key=key, pure=False, priority=call.to_end_s)
        self._under_way[future] = call
        future.add_done_callback(self._finished.put)

    def next(self) -> tuple[str, StageResult | str, float]:
        """Wait for the next stage to end; its name, its result or the reason of its failure, and its time, s.

        A stage that a process of died is tried once more, on one core, when no other is under way: its memory may have
        run out. One that hangs is ended.
        """
        self._send()
        if not self._under_way and self._died:
            self._submit(self._died.pop(0))
        lost_since: float | None = None
        while True:
            try:
                future = self._finished.get(timeout=_LOOK_EVERY_S)
                break
            except queue.Empty:
                self._send()  # where workers have come
                # Dask tells the end of a stage in a thread of its own, which there may be no memory for.
                if ended := [one for one in self._under_way if one.done()]:
                    future = ended[0]
                    break
                left = self._client.status == "running" and self._client.nthreads()
                lost_since = None if left else lost_since or time.monotonic()
                lost_s = 0.0 if lost_since is None else time.monotonic() - lost_since
                answers = self._client.status == "running"
                starts = answers and lost_s > _LOST_S and any(map(_processes_of, self._nannies))
                if self._client.status == "closed" or lost_s > (_STARTS_S if starts else _LOST_S):
                    lost = next(iter(self._under_way), None)
                    one = self._waiting.pop(0) if lost is None else self._under_way.pop(lost)
                    return one.name, "The scheduler, or every worker, has stopped.", 0.0
                if hung := self._hung():
                    return self._ended(hung)
        call = self._under_way.pop(future, None)
        self._send()  # before the results of this stage are recorded
        if call is None:  # abandoned before
            return self.next()
        name = call.name
        begun = self._silent_s.pop(name, None) is not None
        error = future.exception() if future.status == "error" else None
        death = None if error is None else _death(error)
        if future.status == "finished" or death:
            outcome, seconds = (death, 0.0) if death else future.result()
            if not isinstance(outcome, WorkerError):
                lines = (f"{_TRIED} {call.died}",) if call.died else ()
                again = isinstance(outcome, StageResult) and lines
                return name, replace(outcome, lines=(*outcome.lines, *lines)) if again else outcome, seconds
            if isinstance(error, KilledWorker) and not (begun or call.died) and call.lost < _MOST_LOST:
                # Dask blames all that wait for a worker that dies
                self._waiting.append(replace(call, lost=call.lost + 1))
                return self.next()
            if call.died:
                needs = f"; its estimated memory need is {call.gib:.1f} GiB" if call.gib else ""
                return name, f"{outcome} A second attempt, with no other stage running, failed too{needs}.", seconds
            self._died.append(replace(call, died=str(outcome)))
            return self.next()
        if error is None:
            return name, f"The connection to the scheduler was lost, or it cancelled the stage ({future.status}).", 0.0
        return name, f"Its worker failed ({error}). Run the study again; finished stages are kept.", 0.0

    def _hung(self) -> "Future[Any] | None":
        """A stage that has told nothing new for too long, if there is one; those that may become one are named."""
        for future, call in self._under_way.items():
            if call.name not in self._silent_s:  # it waits for a worker
                continue
            before = self._silent_s[call.name]
            self._silent_s[call.name] = silent_s = before + _LOOK_EVERY_S
            if silent_s > call.may_be_silent_s:
                return future
            if silent_s // _NAME_EVERY_S > before // _NAME_EVERY_S:
                limit = f"After {duration(call.may_be_silent_s)} it is stopped; the others continue"
                end = f"{limit}; Ctrl-C ends the run, and finished stages are kept."
                self._watch(NOTE, f"{call.name} has made no progress for {duration(silent_s)}. {end}", 0.0)
        return None

    def _ended(self, hung: "Future[Any]") -> tuple[str, str, float]:
        """End a stage that hangs with its worker, which is started anew where a nanny watches it.

        What waits for that worker is queued anew: Dask would count the end of the worker against it.
        """
        call = self._under_way[hung]
        silent_s = self._silent_s.pop(call.name)
        places = {address: {*keys} for address, keys in self._client.processing().items() if hung.key in keys}
        held = {hung.key}.union(*places.values())
        cancelled = [future for future in self._under_way if future.key in held]
        calls = [self._under_way.pop(future) for future in cancelled]
        self._client.cancel(cancelled)
        for nanny in self._nannies:
            if nanny.worker_address in places:  # what hangs in native code would not notice that its worker is gone
                _kill(_processes_of(nanny)[1:])
        self._client.restart_workers([*places], raise_for_error=False)
        self._waiting += [waiting for waiting in calls if waiting is not call]
        return (
            call.name,
            f"It made no progress for {duration(silent_s)} and was stopped. The usual causes are a network disk that "
            "does not answer, another run that holds the stage, and a machine that swaps its memory to disk. Run the "
            "study again; finished stages are kept.",
            silent_s,
        )

    @property
    def _nannies(self) -> list[Nanny]:
        return [] if self._local is None else [*self._local.workers.values()]

    @property
    def busy(self) -> bool:
        """Whether a stage is running or waiting."""
        return bool(self._waiting or self._under_way or self._died)


def _death(error: BaseException) -> WorkerError | None:
    """The death of a worker, or its lack of memory, if that is why its stage has failed."""
    if isinstance(error, KilledWorker):
        return WorkerError(
            "Its worker process died: the system ended it, most often for lack of memory, or native code crashed. Use "
            "fewer workers, or machines with more memory."
        )
    return WorkerError(lack_of_machine(error)) if is_lack_of_memory(error) else None


@contextmanager
def cluster(
    watch: OnProgress, places: Sequence[Path], *, scheduler: str | None = None, workers: int | None = None
) -> Iterator[StageRunner]:
    """A cluster of this machine's cores, or of the scheduler at an address (tls://node1:8786); its stages end with it.

    ``watch(stage, what, fraction)`` is called with the progress. Every worker must have access to ``places``, the
    folders of results. InputError if the scheduler is on a network without TLS, cannot be reached, or has no workers or
    unsuitable ones.
    """
    logging.getLogger("distributed").setLevel(logging.ERROR)  # stages have their own log
    with dask.config.set(_SETTINGS):
        if scheduler is None:
            encrypted = {"distributed.comm.require-encryption": False}  # asked for with clusters in mind
            with dask.config.set(encrypted), _of_this_machine(workers or usable_cores()) as (local, client):
                client.run(_ignore_interrupts)
                yield StageRunner(client, watch, local)
            return
        with at_address(scheduler, places) as client:
            runner = StageRunner(client, watch)
            try:
                yield runner
            finally:
                client.cancel(list(runner._under_way))


@contextmanager
def _of_this_machine(workers: int) -> Iterator[tuple[LocalCluster, Client]]:
    """A cluster of processes of this machine, ended with the block however that ends, with their temporary files."""
    with _temporary_files(), _no_worker_left():
        local = LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, silence_logs=_NOTHING_LOGGED, memory_limit=0,
            host="127.0.0.1", dashboard_address="127.0.0.1:0",
        )  # fmt: skip
        try:
            with Client(local) as client:
                try:
                    yield local, client
                except BaseException:
                    _kill_workers(local)
                    raise
        finally:
            try:
                local.close()
            except TimeoutError:  # a worker that lacks memory may not end when it is asked to
                _kill_workers(local)


@contextmanager
def _temporary_files() -> Iterator[None]:
    """One folder for all temporary files of workers and stages, since a process that is ended cannot remove its own."""
    before = os.environ.get("TMPDIR")
    with tempfile.TemporaryDirectory(prefix="mrstrain-", ignore_cleanup_errors=True) as folder:
        os.environ["TMPDIR"] = folder  # of the processes that are started meanwhile
        try:
            with dask.config.set({"temporary-directory": folder}):
                yield
        finally:
            os.environ.pop("TMPDIR", None)
            if before is not None:
                os.environ["TMPDIR"] = before


@contextmanager
def _no_worker_left() -> Iterator[None]:
    """End the workers that Dask leaves where it cannot start all of them; this process would wait for them to end."""
    before = multiprocessing.active_children()
    try:
        yield
    finally:
        for child in multiprocessing.active_children():
            if child not in before and child.name.startswith(_WORKER):
                _kill(_with_all_below(child.pid))


def _ignore_interrupts() -> None:
    """Leave Ctrl-C, which a terminal sends to every process, to the one that a person has started."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _kill_workers(local: LocalCluster) -> None:
    """End the processes of a cluster and what they have started; Dask would wait for stages that do not listen."""
    for nanny in [*local.workers.values()]:
        nanny.auto_restart = False
        _kill(_processes_of(nanny))


def _processes_of(nanny: Nanny) -> list[psutil.Process]:
    """The process of a worker, which comes first as it would begin the next stage, and all below it."""
    return _with_all_below(nanny.pid)


def _with_all_below(pid: int | None) -> list[psutil.Process]:
    if pid is None:  # about to be restarted; psutil would take it for this process
        return []
    try:
        worker = psutil.Process(pid)
        return [worker, *worker.children(recursive=True)]
    except psutil.Error:
        return []


def _kill(processes: Sequence[psutil.Process]) -> None:
    for process in processes:
        with suppress(psutil.Error):
            if not any(spared in word for word in process.cmdline() for spared in _SPARED):
                process.kill()


def _run(topic: str, call: _Call) -> tuple[Outcome, float]:
    """Run a stage in a process below a worker."""
    began, worker = time.monotonic(), get_worker()

    def tell(what: str, fraction: float) -> None:
        worker.log_event(topic, (call.name, what, fraction))

    tell("once more" if call.died else "begun", 0.0)
    outcome = run_stage(call.name, call.function, call.arguments, call.lock, tell, alone=bool(call.died))
    return outcome, time.monotonic() - began
