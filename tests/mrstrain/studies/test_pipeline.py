"""What is run, what is not run again, and what a failure leaves standing; with stages that only write a file."""

from __future__ import annotations

import json
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from dvc.errors import InputError
from dvc.software import distribution_versions, software_key
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.pipeline import Pipeline, run_all
from mrstrain.studies.plan import Stage
from mrstrain.studies.run import refuse_unknown
from mrstrain.studies.scheduler import _refuse_unfit
from mrstrain.studies.stages import StageResult


class Here:
    """A cluster that runs stages at once: each writes down what it reads."""

    def __init__(self, failing: tuple[str, ...] = ()) -> None:
        self.failing, self.ran, self._ended = failing, [], []

    @property
    def busy(self) -> bool:
        return bool(self._ended)

    def begin(
        self, name: str, function: str, arguments: dict, lock: Path, to_end_s: float = 0.0, gib: float = 0.0
    ) -> None:
        self.ran.append(name)
        out = Path(arguments["out"])
        if name in self.failing:
            out.write_text("half")
            self._ended.append((name, "It broke.", 1.0))
            return
        read = [Path(p).read_text() for p in [*arguments["reads"], *arguments.get("parts", [])]]
        out.write_text(json.dumps([name, arguments["number"], *read]))
        self._ended.append((name, StageResult((f"{name} done",)), 1.0))

    def next(self) -> tuple[str, StageResult | str, float]:
        return self._ended.pop(0)

    def keep(self, left: int) -> None:
        self.left = left


def stages_in(folder: Path, number: int = 1) -> list[Stage]:
    """Two measurements, a mesh and two models on it, and their comparison."""
    out = folder / "results"

    def stage(name: str, reads: tuple[str, ...], made: tuple[str, ...] = (), some: dict | None = None) -> Stage:
        given = [str(folder / r) for r in reads] + [str(out / m) for m in made]
        place = out / name.replace(" ", "_")
        arguments = {"out": str(place), "reads": given, "number": number if name == "mesh" else 0}
        waits = tuple(m.replace("_", " ") for m in made)
        return Stage(name, arguments, tuple(folder / r for r in reads), (place,), waits, some or {})

    parts = {f"{kind} {n}": str(out / f"{kind}_{n}") for kind in ("register", "simulate") for n in "ab"}
    return [
        stage("register a", ("a.txt",)),
        stage("register b", ("b.txt",)),
        stage("mesh", ("labels.txt",)),
        stage("simulate a", (), ("mesh",)),
        stage("simulate b", (), ("mesh",)),
        stage("compare", ("labels.txt",), (), {"parts": parts}),
    ]


def ran(folder: Path, number: int = 1, failing: tuple[str, ...] = (), seconds: dict[str, float] | None = None, **how):
    """Run the stages; give what was run, and the outcomes."""
    cluster, asked = Here(failing), []

    @contextmanager
    def pool():
        asked.append(1)
        yield cluster

    told: list[str] = []
    pipeline = Pipeline(stages_in(folder, number), Ledger(folder / "results", folder), **how)
    pipeline.seconds_to_end = seconds or {}
    run_all({"": pipeline}, pool, {"": told.append})
    outcomes = pipeline.outcomes
    assert len(asked) == bool(cluster.ran)  # no workers are started for nothing
    return cluster.ran, outcomes, told


ALL = ["register a", "register b", "mesh", "simulate a", "simulate b", "compare"]


def test_finished_work_is_not_done_again(folder):
    first, outcomes, told = ran(folder)
    assert first == ALL
    assert all(o.status == "done" for o in outcomes.values())
    assert "compare: done after 1 s" in told
    assert "    compare done" in told
    again, outcomes, _ = ran(folder)
    assert again == []
    assert all(o.status == "up to date" for o in outcomes.values())


def test_the_stage_with_the_longest_row_behind_it_is_started_first(folder):
    order = ran(folder, seconds={"register a": 20.0, "register b": 30.0, "mesh": 90.0, "simulate b": 60.0})[0]
    assert order == ["mesh", "register b", "register a", "simulate b", "simulate a", "compare"]


def test_changed_content_of_the_same_size_is_done_again_and_what_builds_on_it(folder):
    ran(folder)
    (folder / "a.txt").write_text("z")
    assert ran(folder)[0] == ["register a", "compare"]
    assert '"z"' in (folder / "results" / "compare").read_text().replace("\\", "")


@pytest.mark.parametrize("gone", [False, True])
def test_an_input_that_changes_under_a_run_is_named(folder, monkeypatch, gone):
    """Later stages read what earlier ones had not, and the report was one of both, marked as up to date."""

    class Changing(Here):
        def next(self) -> tuple[str, StageResult | str, float]:
            ended = super().next()
            if ended[0] == "compare":
                (folder / "a.txt").unlink() if gone else (folder / "a.txt").write_text("z")
            return ended

    with monkeypatch.context() as changed:
        changed.setitem(globals(), "Here", Changing)
        _, outcomes, told = ran(folder)
    status = {name: outcome.status for name, outcome in outcomes.items()}
    assert status == dict.fromkeys(ALL, "done") | {"register a": "OUT OF DATE", "compare": "OUT OF DATE"}
    assert "register a: OUT OF DATE. An input file of this stage changed while the study ran; run it again." in told
    assert "compare: OUT OF DATE. It depends on results that are out of date: register a." in told
    (folder / "a.txt").write_text("z")
    again, outcomes, _ = ran(folder)
    assert again == ["register a", "compare"]
    assert all(outcome.complete for outcome in outcomes.values())


def test_a_new_number_is_done_again_and_what_builds_on_it(folder):
    ran(folder)
    assert ran(folder, number=2)[0] == ["mesh", "simulate a", "simulate b", "compare"]


def test_a_result_that_was_lost_is_made_again(folder):
    ran(folder)
    (folder / "results" / "simulate_b").unlink()
    assert ran(folder)[0] == ["simulate b", "compare"]
    (folder / "results" / "register_a").write_text("cut")
    assert ran(folder)[0] == ["register a", "compare"]


def test_a_failure_is_named_and_the_others_finish(folder):
    first, outcomes, told = ran(folder, failing=("register b", "simulate a"))
    assert first == ALL
    assert outcomes["register b"].status == "FAILED"
    assert outcomes["register b"].reason == "It broke."
    assert outcomes["compare"].record is not None
    assert "register b" not in (folder / "results" / "compare").read_text()
    assert not (folder / "results" / "register_b").exists()  # a half result is none
    assert "register b: FAILED after 1 s. It broke." in told
    assert ran(folder)[0] == ["register b", "simulate a", "compare"]


def test_what_cannot_do_without_a_failed_one_is_not_run(folder):
    first, outcomes, _ = ran(folder, failing=("mesh",))
    assert "simulate a" not in first
    assert outcomes["simulate a"].status == "not run"
    assert str(outcomes["simulate a"]) == "simulate a: not run (mesh has no result)."
    assert outcomes["simulate a"].headline == "not run (mesh has no result)."
    _, outcomes, _ = ran(folder, failing=("mesh", "register a", "register b"), force=("register",))
    assert outcomes["compare"].status == "not run"
    assert (folder / "results" / "compare").exists()  # nothing that was finished is lost
    assert ran(folder)[0] == ["register a", "register b", "mesh", "simulate a", "simulate b", "compare"]


def test_a_result_of_other_inputs_does_not_outlive_a_failure(folder):
    ran(folder)
    (folder / "a.txt").write_text("z")
    _, outcomes, _ = ran(folder, failing=("register a",))
    assert outcomes["register a"].record is None
    assert not (folder / "results" / "register_a").exists()
    assert '"a"' not in (folder / "results" / "compare").read_text().replace("\\", "")


def test_only_and_force(folder):
    first, outcomes, _ = ran(folder, only=("register",))
    assert first == ["register a", "register b"]
    assert outcomes["mesh"].status == "not run"
    ran(folder)
    assert ran(folder, force=("simulate b",))[0] == ["simulate b", "compare"]
    assert ran(folder, force=("register",))[0] == ["register a", "register b", "compare"]
    (folder / "a.txt").write_text("z")
    first, outcomes, _ = ran(folder, only=("mesh", "simulate", "compare"))
    assert first == []
    assert outcomes["register a"].reason.startswith("The inputs have changed")
    assert outcomes["compare"].status == "OUT OF DATE"  # what builds on it is no newer
    assert outcomes["compare"].reason == "It depends on results that are out of date: register a."
    assert [name for name, one in outcomes.items() if not one.requested] == ["register a", "register b"]
    assert [name for name, one in outcomes.items() if not one.complete] == ["register a", "compare"]
    first, outcomes, _ = ran(folder, only=("compare",), force=("compare",))
    assert first == ["compare"]
    assert not outcomes["compare"].complete
    assert all(one.complete for one in ran(folder)[1].values())


@pytest.mark.parametrize(
    ("only", "force", "says"),
    [
        (("registr",), (), "no stage or kind of stage 'registr'. Kinds in this study: register, .*Stages: register a"),
        (("register",), ("mesh",), r"force \(mesh\) has no effect, because only \(register\) excludes this stage"),
        (("register a",), ("register b",), r"force \(register b\) has no effect"),
    ],
)
def test_what_no_stage_answers_to_is_refused(folder, only, force, says):
    with pytest.raises(InputError, match=says):
        refuse_unknown(stages_in(folder), only, force)
    for fine in (((), force), (("register",), ("register a",)), (("register b",), ("register",))):
        refuse_unknown(stages_in(folder), *fine)


@dataclass
class Workers:
    """A client of one worker that gives a certain answer."""

    answer: tuple[str, bool, bool] | None
    threads: int = 1

    def run(self, *_: object) -> dict[str, tuple[str, bool, bool]]:
        if self.answer is None:
            raise ModuleNotFoundError("No module named 'mrstrain'")
        return {"tcp://far:1": self.answer}

    def nthreads(self) -> dict[str, int]:
        return {"tcp://far:1": self.threads}


HERE, NUMPY = software_key("mrstrain"), f"numpy {distribution_versions()['numpy']}"


@pytest.mark.parametrize(
    ("workers", "says"),
    [
        (Workers(None), "mrstrain is not installed"),
        (
            Workers(("0.1.0, code abc", False, True)),
            "has 0.1.0, code abc, but this machine has mrstrain ",
        ),  # as earlier ones answer
        (
            Workers((HERE.replace(NUMPY, "numpy 1.0"), False, True)),
            f"has numpy 1.0, but this machine has {NUMPY}. Start",
        ),
        (Workers((HERE, False, False)), "has no access to"),
        (Workers((HERE, False, True), threads=4), "runs 4 stages at the same time"),
        (Workers((HERE, True, True)), "may not start processes"),
    ],
)
def test_workers_that_would_not_do_are_refused_by_what_they_lack(tmp_path, workers, says):
    with pytest.raises(InputError, match=says):
        _refuse_unfit(workers, "tcp://far:0", [tmp_path])
    assert not list(tmp_path.iterdir())
    _refuse_unfit(Workers((HERE, False, True)), "tcp://far:0", [tmp_path])


@pytest.mark.parametrize("name", ["study", "Müller Ö 'x'"])
def test_a_moved_study_stays_finished(folder, tmp_path_factory, name):
    named = folder.with_name(name)
    folder.rename(named)
    ran(named)
    for record in (named / "results" / ".study").glob("*.json"):
        assert str(named) not in repr(json.loads(record.read_text())["made_from"])
    moved = tmp_path_factory.mktemp("elsewhere") / "moved"
    named.rename(moved)
    assert ran(moved)[0] == []


def test_the_forecast_knows_what_cannot_be_run(folder):
    def told(only: tuple[str, ...]) -> dict[str, str]:
        return Pipeline(stages_in(folder), Ledger(folder / "results", folder), only=only).forecast()

    assert told(("simulate",))["simulate a"] == "cannot run: mesh has no result."
    assert told(("compare",))["compare"].startswith("cannot run: none of register a")
    assert told(("mesh", "simulate"))["simulate a"] == "will run"
    assert told(("register", "compare"))["compare"] == "will run"
    ran(folder, failing=("mesh",))
    assert told(("compare",))["compare"] == "up to date"  # of the measurements alone, as a run takes it
    ran(folder)
    assert set(told(("compare",)).values()) == {"not requested", "up to date"}
    (folder / "results" / ".study" / "mesh.json").unlink()
    assert told(("simulate",))["simulate a"] == "cannot run: mesh has no result."
    assert told(("compare",))["compare"] == "will run"  # models that a mesh is lost of are no result any more
    assert "compare" in ran(folder, only=("compare",))[0]


def test_the_forecast_is_what_is_run(folder):
    def forecast(number: int = 1, **how) -> list[str]:
        told = Pipeline(stages_in(folder, number), Ledger(folder / "results", folder), **how).forecast()
        return [name for name, what in told.items() if what == "will run"]

    assert forecast() == ALL
    assert not (folder / "results" / "mesh").exists()
    ran(folder)
    assert forecast() == []
    assert forecast(force=("simulate b",)) == ["simulate b", "compare"]
    (folder / "b.txt").write_text("y")
    assert forecast() == ["register b", "compare"] == ran(folder)[0]
    assert forecast(number=3) == ran(folder, number=3)[0]


def test_what_may_be_lacking_is_gone_without(folder):
    def planned() -> list[Stage]:
        plain, *others = stages_in(folder)
        out = str(folder / "results" / "register_b")
        return [
            *others,
            Stage(plain.name, plain.arguments, plain.files, plain.gives, (), {}, {"parts": {"register b": out}}),
        ]

    def run(failing: tuple[str, ...]) -> tuple[list[str], dict]:
        cluster = Here(failing)
        pipeline = Pipeline(planned(), Ledger(folder / "results", folder))
        run_all({"": pipeline}, lambda: nullcontext(cluster), {"": lambda _: None})
        return cluster.ran, pipeline.outcomes

    first, outcomes = run(("register b",))
    assert outcomes["register a"].status == "done"
    assert first.index("register b") < first.index("register a")
    assert run(())[0] == ["register b", "register a", "compare"]  # and made anew when it is there


def test_a_result_that_may_come_out_better_is_run_again(folder):
    class Halting(Here):
        def next(self) -> tuple[str, StageResult | str, float]:
            name, given, seconds = super().next()
            again = name == "simulate a" and isinstance(given, StageResult)
            return name, replace(given, complete=False, retry=True) if again else given, seconds

    def run(cluster: Here) -> list[str]:
        run_all(
            {"": Pipeline(stages_in(folder), Ledger(folder / "results", folder))},
            lambda: nullcontext(cluster),
            {"": lambda _: None},
        )
        return cluster.ran

    assert run(Halting()) == ALL
    assert run(Here()) == ["simulate a", "compare"]
    assert run(Here()) == []


def test_an_input_that_vanishes_fails_its_stage_alone(folder):
    (folder / "a.txt").unlink()
    first, outcomes, _ = ran(folder)
    assert outcomes["register a"].status == "FAILED"
    assert "a.txt" in outcomes["register a"].reason
    assert first == ALL[1:]


def test_taken_as_they_are_stale_results_are_called_so_and_reasons_are_kept(folder):
    ran(folder, failing=("register b",))
    (folder / "a.txt").write_text("z")
    pipeline = Pipeline(stages_in(folder), Ledger(folder / "results", folder), only=("nothing",))
    assert pipeline.settle() == []
    assert pipeline.outcomes["register a"].status == "OUT OF DATE"
    assert not pipeline.outcomes["register a"].complete
    assert pipeline.outcomes["register b"].reason == "It broke."
    assert pipeline.outcomes["mesh"].complete


def test_what_other_code_made_is_made_anew(folder, monkeypatch):
    ran(folder)
    assert ran(folder)[0] == []
    monkeypatch.setattr("mrstrain.studies.ledger.software_key", lambda _: "other")
    assert ran(folder)[0] == ALL
    assert ran(folder)[0] == []
