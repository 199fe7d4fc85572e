"""A simulation that was cut goes on: the same end as of one that was not, and nothing is solved twice."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, fields
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.mesh import TetMesh
from fe import Checkpoint, LoadState, LoadStep, NeoHooke, Plate, Problem, cauchy_stress, write_tet_mesh
from fe.simulation_files import fingerprint, read_checkpoint, write_checkpoint
from mrstrain.cli.app import app
from mrstrain.studies import stages
from tests.fe.solving import Notebook, solved
from tests.fe.test_simulate import ALONG, DOWN, LAWS, dome

PLATE = Plate(DOWN, ALONG, turns=True)
LOADS = [LoadStep("a", 2.0), LoadStep("b", 2.0, 1.0)]
GIVEN = ["--load", "a=2", "--load", "b=2,1", "--load", "c=2,2", "--set", "luboz", "--plate-normal", "-1", "0", "0"]
GIVEN += ["--shear-direction", "0", "1", "0", "--workers", "1"]


def run(loads: list[LoadStep] = LOADS, **others) -> tuple[list[LoadState], list[str], list[tuple[str, Checkpoint]]]:
    heard = Notebook()
    states = solved(dome((3, 4, 4)), LAWS, PLATE, loads, observer=heard, **others)
    return states, heard.lines, heard.increments


@pytest.fixture(scope="module")
def whole() -> tuple[list[LoadState], list[str], list[tuple[str, Checkpoint]]]:
    return run()


def test_going_on_from_a_load_ends_where_an_uncut_run_ends(whole, tmp_path: Path) -> None:
    states, told, _ = whole
    write_checkpoint(tmp_path / "a.npz", states[0].checkpoint, "this")
    again, lines, _ = run(earlier={"a": read_checkpoint(tmp_path / "a.npz", "this")})
    for state, other in zip(states, again, strict=True):  # bit for bit
        for array in ("u_mm", "pressure_mpa", "gradients", "on_plate"):
            assert np.array_equal(getattr(other, array), getattr(state, array)), array
        assert (other.reached, other.iterations) == (state.reached, state.iterations)
        for at, there in zip(state.curve, other.curve, strict=True):
            assert all(np.array_equal(getattr(at, name.name), getattr(there, name.name)) for name in fields(at))
    assert 0 < len(lines) < len(told)
    assert lines == told[-len(lines) :]  # the second load's steps, and none of the first's
    assert not any("moved" in line for line in lines)


@pytest.mark.parametrize("load", ["a", "b"])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_going_on_from_the_middle_of_a_load(whole, load: str, share: float) -> None:
    states, told, way = whole
    on_way = [kept for name, kept in way if name == load and kept.reached < 1.0]
    kept = on_way[int(share * len(on_way))]
    assert 0.0 < kept.reached < 1.0
    again, lines, _ = run(earlier={"a": kept} if load == "a" else {"a": states[0].checkpoint, "b": kept})
    assert share == 0.0 or len(lines) < len(told)
    for state, other in zip(states, again, strict=True):
        assert other.reached == 1.0
        assert other.force_n == pytest.approx(state.force_n, abs=2e-3)
        # the increments are others, and so are the places where the tape holds: what docs/simulate.md says of digits
        assert np.abs(other.u_mm - state.u_mm).max() < 1e-3 * np.abs(state.u_mm).max()
        stress, there = (cauchy_stress(one, dome((3, 4, 4)), LAWS) for one in (state, other))
        assert np.abs(there - stress).max() < 1e-2 * np.abs(stress).max()


def test_a_path_whose_time_is_over_ends_where_it_stands_and_goes_on(
    whole, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("fe.solution.time", SimpleNamespace(monotonic=count().__next__))
    cut, _, _ = run(limit_s=2)  # asked before every step: two are made
    assert [state.load.name for state in cut] == ["a"]
    assert cut[0].out_of_time
    assert 0.0 < cut[0].reached < 1.0
    assert cut[0].force_n[0] == pytest.approx(2.0 * cut[0].reached, rel=0.01)
    write_checkpoint(tmp_path / "a.npz", cut[0].checkpoint, "this")
    on, _, _ = run(earlier={"a": read_checkpoint(tmp_path / "a.npz", "this")})
    for state, other in zip(whole[0], on, strict=True):
        assert (other.reached, other.out_of_time, state.out_of_time) == (1.0, False, False)
        assert other.force_n == pytest.approx(state.force_n, abs=2e-3)


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("steps", [0, 1, 2])
def test_a_path_cut_while_the_plate_approaches_ends_where_an_uncut_one_does(
    monkeypatch: pytest.MonkeyPatch, turns: bool, steps: int
) -> None:
    plate = Plate(DOWN, ALONG, turns=turns)

    def going(**others) -> LoadState:
        return solved(dome((3, 4, 4)), LAWS, plate, LOADS[:1], **others)[0]

    whole = going()
    with monkeypatch.context() as clock:
        clock.setattr("fe.solution.time", SimpleNamespace(monotonic=count().__next__))
        cut = going(limit_s=steps)
    assert cut.out_of_time
    assert 0.0 <= cut.reached < 1.0
    on = going(earlier={"a": cut.checkpoint})
    assert on.plate_displacement_mm[0] == pytest.approx(whole.plate_displacement_mm[0], abs=2e-3)
    assert np.abs(on.u_mm - whole.u_mm).max() < 0.01 * np.abs(whole.u_mm).max()


@pytest.mark.usefixtures("in_this_process")
def test_the_command_tells_that_time_was_over(tmp_path: Path) -> None:
    write_tet_mesh(tmp_path / "dome.vtu", dome((3, 4, 4)), {})
    given = [*GIVEN, "--out", str(tmp_path / "out"), "--limit-minutes", "0.00001"]
    ended = CliRunner().invoke(app, ["simulate", str(tmp_path / "dome.vtu"), *given])
    assert ended.exit_code == 1
    assert "a: the time limit was reached before the first equilibrium" in ended.output
    assert "b was not tried" in ended.output


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize(("limit_s", "complete"), [(1e-6, False), (None, True)])
def test_a_stage_tells_that_nothing_but_time_was_lacking(tmp_path: Path, limit_s: float | None, complete: bool) -> None:
    write_tet_mesh(tmp_path / "dome.vtu", dome((3, 4, 4)), {})
    given = stages.simulate(
        lambda *_: None, out=str(tmp_path / "out"), mesh=str(tmp_path / "dome.vtu"), sets=["luboz"],
        loads=[asdict(load) for load in LOADS[:1]], plate_normal=DOWN, shear_direction=ALONG, limit_s=limit_s,
    )  # fmt: skip
    assert given.complete is complete
    assert not given.retry


def test_what_was_made_from_something_else_is_not_used(whole, tmp_path: Path) -> None:
    mesh = dome((3, 4, 4))

    def made_from(mesh: TetMesh = mesh, laws=LAWS, plate: Plate = PLATE, loads=LOADS, element: str = "P1") -> str:
        return fingerprint(Problem(mesh, laws, plate, loads, element=element), loads[-1])

    shifted = TetMesh(mesh.points_mm + 1e-9, mesh.cells, mesh.regions, mesh.facets)
    less = TetMesh(mesh.points_mm, mesh.cells, mesh.regions, mesh.facets | {"bone": mesh.facets["bone"][1:]})
    others = [
        made_from(shifted),
        made_from(less),
        made_from(laws=LAWS | {"skin": NeoHooke.of(0.2, nu=0.499)}),
        made_from(plate=Plate(DOWN, ALONG, turns=True, pivot_mm=[0, 1, 0])),
        made_from(plate=Plate(DOWN, ALONG)),
        made_from(plate=Plate(DOWN, ALONG, turns=True, gap_mm=0.5)),
        made_from(loads=[LoadStep("a", 2.0), LoadStep("b", 2.0, 1.1)]),
        made_from(loads=[LoadStep("a", 2.0), LoadStep("b", 2.0, shear_mm=1.0)]),
        made_from(element="P2"),
    ]
    assert len({made_from(), *others}) == len(others) + 1
    slides = Plate(DOWN, ALONG, taped=False)  # and so carries no shear
    assert made_from(plate=slides, loads=LOADS[:1]) != made_from(plate=Plate(DOWN, ALONG), loads=LOADS[:1])
    renamed = [LoadStep("x", 2.0), LoadStep("b", 2.0, 1.0)]
    assert made_from(dome((3, 4, 4)), loads=renamed) == made_from()
    place = tmp_path / "a.restart.npz"
    write_checkpoint(place, whole[0][0].checkpoint, made_from())
    assert read_checkpoint(place, made_from()) is not None
    assert read_checkpoint(place, others[0]) is None
    assert read_checkpoint(tmp_path / "b.restart.npz", made_from()) is None
    written = place.read_bytes()
    table = written.rindex(b"PK\x01\x02")  # what it tells of the last array: its kind of compression
    for damaged in (written[:-200], written[: table + 10] + b"c" + written[table + 11 :]):
        place.write_bytes(damaged)
        assert read_checkpoint(place, made_from()) is None


def killed_after_the_first_load(command: list[str], out: Path) -> None:
    started = subprocess.Popen(
        [sys.executable, "-m", "mrstrain", *command],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        while not (out / "a.vtu").exists():  # written when the load is done; a restart file may be of a load on its way
            assert started.poll() is None
            time.sleep(0.02)
    finally:
        os.killpg(started.pid, signal.SIGKILL)
        started.wait()


@pytest.mark.usefixtures("in_this_process")
def test_a_killed_command_goes_on_where_it_was(tmp_path: Path) -> None:
    write_tet_mesh(tmp_path / "dome.vtu", dome((4, 6, 6)), {})
    command = ["simulate", str(tmp_path / "dome.vtu"), *GIVEN]
    uncut = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "uncut")])
    assert uncut.exit_code == 0, uncut.output
    out = tmp_path / "cut" / "luboz"
    for _ in range(5):
        killed_after_the_first_load([*command, "--out", str(out.parent)], out)
        if not (out / "c.restart.npz").exists():
            break
        shutil.rmtree(out.parent)  # on a busy machine it was seen late
    assert json.loads((out / "simulation.json").read_text()) == {"outcome": {}}  # of a simulation that has not ended
    assert not (out / "c.restart.npz").exists()
    so_far = (out / "log-a.txt").read_text().splitlines()
    assert any(line.startswith("moved: displacement") for line in so_far)  # there as it is made
    again = CliRunner().invoke(app, [*command, "--out", str(out.parent)])
    assert again.exit_code == 0, again.output
    log = (out / "log-a.txt").read_text().splitlines()
    assert log[0] == "a: resumed from the checkpoint at 100 % of the load"
    assert not any(line.startswith("moved") for line in log)
    for load in ("a", "b", "c"):
        one, other = (meshio.read(folder / "luboz" / f"{load}.vtu") for folder in (tmp_path / "uncut", out.parent))
        assert np.abs(one.point_data["displacement_mm"] - other.point_data["displacement_mm"]).max() < 1e-9
        assert np.abs(one.point_data["displacement_mm"]).max() > 0.5
    # what is there already is taken, and what no load is called any more is taken away
    CliRunner().invoke(app, [*command[:2], *GIVEN[2:], "--out", str(out.parent)])
    assert not (out / "a.restart.npz").exists()
    assert (out / "b.restart.npz").exists()
