"""What is seen of a run while it goes on: a report that grows, and one that says when it was interrupted."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dvc.report.page import Picture, Section, Table
from dvc.trust.verdict import Verdict
from mrstrain.records.progress import ALL
from mrstrain.records.time_left import Expected, TimeLeft
from mrstrain.studies import watch as watching
from mrstrain.studies.file import Study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.pipeline import Pipeline, StageOutcome
from mrstrain.studies.plan import plan
from mrstrain.studies.stages import StageResult
from mrstrain.studies.watch import Follower, Report, Watch
from tests.mrstrain.studies.test_page import record, study
from tests.processes import wait_for

assert study  # a fixture
PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c49444154789c63606060000000040001"
    "f61738550000000049454e44ae426082"
)
MEASURED = StageResult(
    ("Load1: Trust.",),
    (
        Section(
            "Load1", Verdict("trust"), (Table("Key results", ("result",), (("rotation",),)),),
            (Picture("Checkerboard", "", PIXEL), Picture("Maximum shear strain", "How <it> is read.", PIXEL)),
            summary=Table("Maximum shear strain", ("tissue", "median", "95th percentile"), (("fat", "0.13", "0.42"),)),
        ),
    ),
    headline="max. shear in fat 0.130 median, 0.420 at the 95th percentile; Trust",
)  # fmt: skip


class Seen:
    """A run of the study's stages, watched: what was told, and which report was shown."""

    def __init__(self, study: Study) -> None:
        self.events: list[tuple[str, str, float]] = []
        self.shown: list[Path] = []
        self.pipeline = Pipeline(plan(study), Ledger(study.out, study.place))
        study.out.mkdir()
        expected = {stage.name: Expected(10.0, before=stage.before) for stage in self.pipeline.stages}
        report = Report(study, self.pipeline, self.shown.append)
        follower = Follower(lambda *event: self.events.append(event))
        self.watch = Watch(follower, {"": report}, TimeLeft(expected, 2))
        self.path = report.path

    def end(self, name: str, given: StageResult | str) -> None:
        kept = record(name, given) if isinstance(given, StageResult) else None
        self.pipeline.outcomes[name] = StageOutcome(name, kept, given if isinstance(given, str) else "")
        self.watch.ended(name, self.pipeline.outcomes[name])

    def page_with(self, *words: str) -> str:
        """The page, as soon as it has these words."""
        wait_for(lambda: self.path.is_file() and all(word in self.path.read_text() for word in words))
        return self.path.read_text()


@pytest.fixture
def seen(study: Study, monkeypatch: pytest.MonkeyPatch) -> Seen:
    monkeypatch.setattr(watching, "_PAGE_EVERY_S", 0.05)
    return Seen(study)


def states(page: str) -> dict[str, tuple[str, str]]:
    """State and finding of each stage, as the page has them."""
    rows = re.findall(
        r"<th scope=row[^>]*>([^<]*)</th><td[^>]*>([^<]*)</td><td[^>]*>([^<]*)</td></tr>", page.split("Stages</h3>")[1]
    )
    return {name: (state, found) for name, state, found in rows}


def test_the_report_grows_while_the_study_runs(seen: Seen) -> None:
    with seen.watch.reporting():
        seen.watch.told("register Load1", "begun", 0.0)
        page = seen.page_with("under way")
        assert states(page)["register Load1"] == ("under way", "")
        assert {state for name, (state, _) in states(page).items() if name != "register Load1"} == {"waiting"}
        assert "<img" not in page
        assert seen.shown == []
        seen.end("register Load1", MEASURED)
        page = seen.page_with("<img")
        assert states(page)["register Load1"] == ("done", MEASURED.headline)
        assert page.count("<img") == 1  # the strain's alone
        assert "Load1: Trust" in page
        assert "Checkerboard" not in page
        assert "Key results" not in page
        assert "0.42" in page
        assert re.search(r"In progress, at [\d:]{8}: 1 of 5 stages are done, about \d+ s left", page)
        assert '<meta http-equiv="refresh" content="10">' in page
        seen.end("register Load2", "The bone was not found.")
        assert states(seen.page_with("bone was not"))["register Load2"] == ("FAILED", "FAILED. The bone was not found.")
    wait_for(lambda: seen.shown == [seen.path])
    for name in ("mesh", "simulate trebbi", "compare"):
        seen.end(name, StageResult(()))
    seen.watch.reports[""].whole()
    page = seen.path.read_text()
    assert "refresh" not in page
    assert "In progress" not in page
    assert "Checkerboard" in page
    assert seen.shown == [seen.path]  # once


def test_the_page_of_a_long_stage_is_renewed(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watching, "_PAGE_AT_LEAST_EVERY_S", 0.3)
    with seen.watch.reporting():
        seen.watch.told("simulate trebbi", "begun", 0.0)
        seen.page_with("under way", "updated every minute")
        seen.path.unlink()
        seen.page_with("under way")


def test_an_interrupted_run_says_so_and_does_not_reload(seen: Seen) -> None:
    seen.end("register Load1", MEASURED)
    with pytest.raises(KeyboardInterrupt), seen.watch.reporting():
        raise KeyboardInterrupt
    page = seen.path.read_text()
    assert re.search(r"Interrupted at [\d:]{8}: 1 of 5 stages are done\. mrstrain run resumes it\.", page)
    assert "refresh" not in page
    assert "<img" in page  # nothing that is finished is lost


def test_a_report_that_cannot_be_written_stops_nothing(seen: Seen) -> None:
    with seen.watch.reporting():
        seen.path.mkdir()
        seen.end("register Load1", MEASURED)
        time.sleep(0.3)
        seen.path.rmdir()
        seen.end("mesh", StageResult((), headline="35,000 tetrahedra"))
        assert states(seen.page_with("35,000"))["mesh"] == ("done", "35,000 tetrahedra")


class Once:
    """A part of the run's picture that fails the first time, as nobody expects."""

    def __init__(self, then: Callable[..., object]) -> None:
        self.calls, self.then = 0, then

    def __call__(self, *given: object, **more: object) -> object:
        self.calls += 1
        if self.calls == 1:
            raise ValueError("no such column")
        return self.then(*given, **more)


def test_a_page_whose_writing_fails_once_is_written_next_time_and_the_reason_is_told(
    seen: Seen, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    failing = Once(watching.write_page_in_progress)
    monkeypatch.setattr(watching, "write_page_in_progress", failing)
    with seen.watch.reporting():
        seen.end("register Load1", MEASURED)
        wait_for(lambda: failing.calls > 0)
        seen.end("mesh", StageResult((), headline="35,000 tetrahedra"))
        wait_for(lambda: failing.calls > 1, limit_s=60.0)
        assert states(seen.page_with("35,000"))["mesh"] == ("done", "35,000 tetrahedra")
    (told,) = caplog.messages
    assert str(seen.path) in told
    assert "ValueError: no such column" in told
    assert "The run goes on" in told


@pytest.mark.parametrize("part", ["progress", "on_report"])
def test_what_is_called_and_fails_does_not_leave_the_page_old(
    seen: Seen, caplog: pytest.LogCaptureFixture, part: str
) -> None:
    failing = Once(lambda *_: None)
    if part == "progress":
        seen.watch.follower = replace(seen.watch.follower, progress=failing)
    else:
        seen.watch.reports[""].on_report = failing
    seen.pipeline.outcomes["register Load1"] = StageOutcome("register Load1", record("register Load1", MEASURED))
    seen.watch._change("register Load1")
    with seen.watch.reporting():
        wait_for(lambda: failing.calls > 0)
        seen.pipeline.outcomes["mesh"] = StageOutcome("mesh", record("mesh", StageResult((), headline="35,000 cells")))
        seen.watch._change("mesh")
        wait_for(lambda: seen.path.is_file() and "35,000" in seen.path.read_text(), limit_s=20.0)
    assert "no such column" in caplog.text


def test_an_interrupt_stays_one_where_its_page_cannot_be_written(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watching, "_PAGE_EVERY_S", 60.0)
    monkeypatch.setattr(watching, "write_page_in_progress", Once(watching.write_page_in_progress))
    with pytest.raises(KeyboardInterrupt), seen.watch.reporting():
        raise KeyboardInterrupt


def test_progress_tells_what_was_found_once_and_the_share_of_the_time(seen: Seen) -> None:
    seen.watch.told("register Load1", "strain and figures", 1.0)  # of the stage's last part: it has not ended
    seen.end("register Load1", MEASURED)
    seen.watch.told("register Load1", "strain and figures", 1.0)  # late
    of_stage = [event[1:] for event in seen.events if event[0] == "register Load1"]
    assert of_stage == [("strain and figures", watching._UNENDED), (MEASURED.headline, 1.0)]
    counts = [what for case, what, _ in seen.events if case == ALL]
    assert counts == ["0 of 5 stages", "1 of 5 stages"]
    assert all(0.0 <= share < 0.1 for case, _, share in seen.events if case == ALL)


def test_stages_that_failed_are_counted(seen: Seen) -> None:
    seen.end("register Load1", MEASURED)
    seen.end("mesh", "The surface is open.")
    counts = [what for case, what, _ in seen.events if case == ALL]
    assert counts[-2:] == ["1 of 5 stages", "2 of 5 stages, 1 failed"]


def test_results_that_were_there_already_are_no_reason_to_open_a_browser(seen: Seen) -> None:
    kept = StageOutcome("register Load1", record("register Load1", MEASURED), reused=True)
    seen.pipeline.outcomes["register Load1"] = kept
    seen.watch.reports[""].in_progress([], 1.0)
    assert "<img" in seen.path.read_text()
    assert seen.shown == []


def test_a_browser_opens_once_the_page_has_a_picture_and_not_before(seen: Seen) -> None:
    seen.end("mesh", MEASURED)  # whose pictures the growing page does not show
    seen.watch.reports[""].in_progress([], 1.0)
    assert "<img" not in seen.path.read_text()
    assert seen.shown == []
    seen.end("register Load1", MEASURED)
    seen.watch.reports[""].in_progress([], 1.0)
    assert seen.shown == [seen.path]


def test_a_run_whose_stages_hang_tells_how_long_it_has_been(seen: Seen) -> None:
    seen.watch.told("mesh", "meshing", 0.5)
    told = len(seen.events)
    with seen.watch.reporting():
        wait_for(lambda: len(seen.events) > told + 2)
    assert {case for case, *_ in seen.events[told:]} == {ALL}
    assert all(0.0 <= fraction < 1.0 for *_, fraction in seen.events[told:])
