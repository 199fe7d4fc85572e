"""Results that FEBio 4 and CalculiX 2.20 wrote, of our own models of a few elements, beside the displacements as text.

``codes.zip`` holds results, models, logs and the displacements that each code printed; the last state counts.
"""

from __future__ import annotations

import re
import shutil
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dvc import TetMesh, read_mesh
from dvc.errors import ImageFileError, InputError, MrstrainError
from tests.blocks import block
from validate import read_result
from validate.rigid_parts import without_rigid_parts
from validate.run_end import _ends_of, early_end

CODES = Path(__file__).with_name("codes.zip")
with zipfile.ZipFile(CODES) as packed:
    RESULTS = sorted(name for name in packed.namelist() if name.endswith((".xplt", ".frd", ".vtk")))

REFUSED = {
    "febio/cut.xplt": "the last section is incomplete",
    "febio/cut2.xplt": "the last section is incomplete",
    "febio/cut3.xplt": "the last section is incomplete",
    "febio/cutmesh.xplt": "the last section is incomplete",
    "febio/text.xplt": "not a FEBio plot file",
    "febio/must.xplt": "FEBio wrote no loaded state",
    "febio/nodisp.xplt": '<var type="displacement"/>',
    "febio/vtk.0.vtk": "the displacement is 0 everywhere",
    "calculix/binary.frd": r"\*NODE FILE",
    "calculix/far.frd": "100 m across",
    "calculix/modes.frd": "the displacement is 0 everywhere",
    "calculix/noU.frd": r"\*NODE FILE, U",
    "calculix/nset.frd": "4 of 8 nodes have no displacement",
}
EARLY = {
    "febio/fails.xplt": "ended with ERROR TERMINATION at time 0.3 of 1 (fails.log)",
    "calculix/fails.frd": "ended at time 0.7 of 1 (fails.inp)",
    "calculix/incs.frd": "ended at time 0.4 of 1 (incs.inp)",
    **{
        f"febio/vtk.{n}.vtk": f"reached its end at time 1 (vtk.log), but vtk.{n}.vtk stops at time 0.{2 * n}"
        for n in (1, 2, 3, 4)
    },
}
# Elements of which the file has more nodes than are taken, or shells and beams that CalculiX has expanded to solids,
# whose nodes are new: the others are compared.
FEWER = {"febio/tet15.xplt", *(f"calculix/{name}.frd" for name in ("shell", "shell8", "beam"))}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("codes")
    with zipfile.ZipFile(CODES) as packed:
        packed.extractall(place)
    return place


def printed(result: Path) -> dict[int, list[float]]:
    """Displacement (mm) by the number of the node, as the code itself printed it for the last state."""
    if result.suffix == ".vtk":
        name, state, _ = result.name.split(".")
        last = result.with_name(f"{name}_U.txt").read_text().split("*Step")[1 + int(state)]
    elif result.suffix == ".xplt":
        last = result.with_name(f"{result.stem}_U.txt").read_text().split("*Step")[-1]
    else:
        text = result.with_suffix(".dat").read_text()
        last = text[text.rindex(" displacements (vx,vy,vz)") :].replace("\n\n", "\n", 1).split("\n\n")[0]
    rows = [line.split() for line in last.splitlines() if line.strip()[:1].isdigit()]
    return {int(number): [float(value) for value in values] for number, *values in rows}


@pytest.mark.parametrize("name", [name for name in RESULTS if name not in REFUSED])
def test_displacements_are_those_that_the_code_printed(folder: Path, name: str) -> None:
    found, truth = read_mesh(folder / name), printed(folder / name)
    u = np.asarray(found.at_nodes["displacement"])
    numbers = found.node_ids if name.endswith(".frd") else np.arange(len(u)) + 1  # FEBio prints nodes in their order
    at = [(place, int(number)) for place, number in enumerate(numbers) if int(number) in truth]
    known = [(place, number) for place, number in at if np.isfinite(u[place]).all()]
    assert len(known) == len(found.node_ids) or name in FEWER
    theirs = np.array([truth[number] for _, number in known])
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(u[[place for place, _ in known]], theirs, rtol=2e-6, atol=2e-6)
    result = read_result("model", folder / name)
    assert np.abs(result.deformation.u_mm).max() == pytest.approx(np.linalg.norm(theirs, axis=1).max(), rel=0.75)


@pytest.mark.parametrize("name", ["febio/hex27.xplt", "febio/hex20.xplt", "calculix/c3d20.frd"])
def test_every_node_of_a_quadratic_brick_keeps_its_displacement(folder: Path, name: str) -> None:
    """Those at the middles of faces and cells too, which could be interpolated from the others."""
    of_file, result = read_mesh(folder / name), read_result("model", folder / name)
    distance, node = cKDTree(result.mesh.points_mm).query(of_file.points_mm)
    np.testing.assert_allclose(distance, 0.0, atol=1e-9)
    np.testing.assert_allclose(result.deformation.u_mm[node], of_file.at_nodes["displacement"], atol=1e-9)


@pytest.mark.parametrize("name", ["shell", "shell8", "beam", "shell2d"])
def test_shells_and_beams_that_calculix_expanded_are_no_tissue(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    """The deck tells them; without it, the node numbers of a shell or beam do, of which an ordinary mesh has none."""
    result = read_result("model", folder / f"calculix/{name}.frd")
    np.testing.assert_allclose(result.mesh.bounds_mm, [[0.0, 0.0, 0.0], [20.0, 20.0, 20.0]], atol=1e-9)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    alone = tmp_path / f"{name}.frd"
    alone.write_bytes((folder / f"calculix/{name}.frd").read_bytes())
    for _ in ("without a deck", "with one whose elements are in another file"):
        caplog.clear()
        read_result("model", alone)
        assert (f"{name}.frd: 1 elements may be shells or beams" in caplog.text) == (name != "shell2d")
        alone.with_suffix(".inp").write_text("*INCLUDE, INPUT=mesh.inp\n*STEP\n*STATIC\n*END STEP\n")


@pytest.mark.parametrize("name", ["c3d8", "c3d20", "c3d6", "c3d15"])
def test_solids_are_no_expanded_shells(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    alone = tmp_path / f"{name}.frd"
    alone.write_bytes((folder / f"calculix/{name}.frd").read_bytes())
    whole = read_mesh(folder / f"calculix/{name}.frd")
    assert read_mesh(alone).cell_count == whole.cell_count > 0
    assert not caplog.text


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_result_is_refused_with_its_cause(folder: Path, name: str) -> None:
    with pytest.raises(MrstrainError, match=REFUSED[name]) as refused:
        read_result("model", folder / name)
    assert Path(name).name in str(refused.value)


@pytest.mark.parametrize("name", [name for name in RESULTS if name not in REFUSED])
def test_runs_that_ended_early_are_known_by_log_or_deck(folder: Path, name: str) -> None:
    end = early_end(folder / name)
    assert (end.reason if end else None) == EARLY.get(name)


@pytest.mark.parametrize(("name", "says"), [("fails", "ended with ERROR TERMINATION at time {}"), ("hex8", None)])
def test_a_state_in_vtk_is_that_of_the_run_in_the_log_beside_it(
    folder: Path, tmp_path: Path, name: str, says: str | None
) -> None:
    shutil.copy(folder / f"febio/{name}.log", tmp_path / "Load1.log")
    for state, time in ((2, 0.4), (5, 1.0)):
        for own in ("Load1.vtk", f"Load1.{state}.vtk"):  # as a person, and as FEBio names it
            shutil.copy(folder / f"febio/vtk.{state}.vtk", tmp_path / own)
            end = early_end(tmp_path / own)
            if says is None:
                assert (end is None) == (time == 1.0)
                assert end is None or end.reason.endswith(f"(Load1.log), but {own} stops at time 0.4")
            else:
                assert end is not None
                assert end.reason == f"{says.format(f'{time:g}')} (Load1.log)"


def test_a_plot_that_stops_before_the_normal_end_of_its_run_is_told(folder: Path, tmp_path: Path) -> None:
    """As one that is copied while the run goes on, with the log of later."""
    for ending in (".log", ".feb"):
        shutil.copy(folder / f"febio/hex8{ending}", tmp_path / f"Load1{ending}")
    whole = (folder / "febio/hex8.xplt").read_bytes()
    at, starts = 4, list[int]()
    while at < len(whole):
        head = struct.unpack_from("<II", whole, at)
        starts += [at] if head[0] == 0x02000000 else []  # a state
        at += 8 + head[1]
    (tmp_path / "Load1.xplt").write_bytes(whole)
    assert early_end(tmp_path / "Load1.xplt") is None
    (tmp_path / "Load1.xplt").write_bytes(whole[: starts[3]])
    end = early_end(tmp_path / "Load1.xplt")
    assert end is not None
    assert end.certain
    assert re.match(r"reached its end at time 1 \(Load1\.log\), but Load1\.xplt stops at time 0\.\d+", end.reason)
    (tmp_path / "Load1.xplt").write_bytes(whole)
    deck = (folder / "febio/hex8.feb").read_text()
    (tmp_path / "Load1.feb").write_text(deck.replace("<time_steps>5<", "<time_steps>50<"))  # for the next run
    assert (tmp_path / "Load1.feb").read_text() != deck
    assert early_end(tmp_path / "Load1.xplt") is None


def test_a_rigid_part_is_no_tissue(folder: Path) -> None:
    """FEBio's has a part of its own, by whose name it is told; the tissue is that of the model without the plate."""
    found = read_result("model", folder / "febio/rigid.xplt")
    assert len(found.rigid_parts) == 1
    assert set(found.mesh.regions).isdisjoint(found.rigid_parts)
    assert found.mesh.points_mm[:, 2].max() == pytest.approx(20.0)
    alone = read_result("model", folder / "febio/hex8.xplt")
    assert len(found.mesh.cells) == len(alone.mesh.cells)
    assert not alone.rigid_parts
    assert np.isfinite(found.deformation.u_mm).all()


@pytest.mark.parametrize("digits", [None, 6])
def test_rigid_parts_are_those_that_moved(digits: int | None) -> None:
    """A plate that turned is one, also where displacements have six digits; tissue that is not loaded is none."""
    boxes = [block((3, 3, 3), (9.0, 9.0, 9.0)) for _ in range(3)]
    points = np.concatenate([box.points_mm + np.array([0.0, 0.0, 20.0 * n]) for n, box in enumerate(boxes)])
    nodes, cells = len(boxes[0].points_mm), len(boxes[0].cells)
    mesh = TetMesh(
        points, np.concatenate([box.cells + nodes * n for n, box in enumerate(boxes)]),
        {name: np.arange(cells) + cells * n for n, name in enumerate(("fat", "far", "plate"))},
    )  # fmt: skip
    u = np.zeros_like(points)
    u[:nodes] = 0.1 * points[:nodes]
    u[nodes : 2 * nodes] = 1e-7 * points[nodes : 2 * nodes]
    turn = Rotation.from_euler("y", 5.0, degrees=True)
    u[2 * nodes :] = turn.apply(points[2 * nodes :]) - points[2 * nodes :] + [0.0, 0.0, 7.0]
    if digits:
        u = np.vectorize(lambda value: float(f"{value:.{digits - 1}e}"))(u)
    kept, moved, names = without_rigid_parts(mesh, u)
    assert names == ("plate",)
    assert set(kept.regions) == {"fat", "far"}
    np.testing.assert_array_equal(moved, u[: 2 * nodes])
    np.testing.assert_array_equal(kept.points_mm, points[: 2 * nodes])
    assert without_rigid_parts(mesh, np.full_like(points, 3.0))[2] == ()  # all of it moves as one: not loaded


def test_parts_are_left_out_by_name(folder: Path) -> None:
    """A plate that deforms is not known to be one."""
    place = folder / "febio/rigid.xplt"
    (plate,) = read_result("model", place).rigid_parts
    found = read_result("model", place, leave_out=[plate.upper()])
    assert found.rigid_parts == ()
    assert plate not in found.mesh.regions
    alone = read_result("model", folder / "febio/hex8.xplt")
    assert len(found.mesh.cells) == len(alone.mesh.cells)
    with pytest.raises(InputError, match=rf"rigid\.xplt: there is no region 'plaet' to leave out; .*{plate}"):
        read_result("model", place, leave_out=["plaet"])
    with pytest.raises(InputError, match=r"rigid\.xplt: all regions are left out"):
        read_result("model", place, leave_out=[plate, *found.mesh.regions])


@pytest.mark.parametrize(
    ("steps", "early"),
    [
        ("*STATIC\n0.1, 1.\n", True),
        ("*STATIC\n0.1, 0.4\n", False),
        ("*STATIC, DIRECT\n ** a remark\n0.1, 0.2\n*STATIC\n0.1, 0.2\n", False),
        ("*STATIC\n0.1, 0.3\n*STATIC, TIME RESET\n0.1, 0.4\n", None),  # the deck does not tell the time
    ],
)
def test_the_time_of_a_deck(folder: Path, tmp_path: Path, steps: str, early: bool | None) -> None:
    (tmp_path / "Load1.frd").write_bytes((folder / "calculix/incs.frd").read_bytes() + b" 9999\n")  # to time 0.4
    (tmp_path / "Load1.inp").write_text(f"*STEP\n{steps}*END STEP\n")
    end = early_end(tmp_path / "Load1.frd")
    assert (end is not None) == (early is not False)
    assert end is None or end.certain == bool(early)


@pytest.mark.parametrize("ending", [".vtu", ".csv", ".msh"])
def test_what_was_exported_from_a_run_is_judged_by_what_lies_beside_it(
    folder: Path, tmp_path: Path, ending: str
) -> None:
    def end(*files: str) -> tuple[str, bool] | None:
        for old in tmp_path.iterdir():
            old.unlink()
        for name in files:
            shutil.copy(folder / name, tmp_path / f"Load1{Path(name).suffix}")
        (tmp_path / f"Load1{ending}").write_text("exported")
        return early_end(tmp_path / f"Load1{ending}")

    assert end() is end("febio/hex8.xplt", "febio/hex8.log") is end("calculix/c3d4.frd", "calculix/c3d4.inp") is None
    assert end("febio/fails.xplt", "febio/fails.log", "febio/fails.feb") == (EARLY["febio/fails.xplt"].replace(
        "fails", "Load1"), True)  # fmt: skip
    assert end("febio/fails.log") == ("ended with ERROR TERMINATION (Load1.log)", True)
    assert end("calculix/incs.frd", "calculix/incs.inp") == ("ended at time 0.4 of 1 (Load1.inp)", True)
    end("calculix/incs.inp")
    increments = [f"     1          {n}     1     2  0.{n}00000E+00  0.{n}00000E+00  0.100000E+00\n" for n in (3, 4)]
    status = tmp_path / "Load1.sta"
    status.write_text("SUMMARY OF JOB INFORMATION\n  STEP      INC     ATT  ITRS     TOT TIME\n" + "".join(increments))
    assert early_end(tmp_path / f"Load1{ending}") == ("ended at time 0.4 of 1 (Load1.inp)", True)
    status.write_text(status.read_text().replace("0.400000E+00", "0.100000E+01"))
    assert early_end(tmp_path / f"Load1{ending}") is None
    status.write_text(" THE ANALYSIS HAS NOT BEEN COMPLETED\n")
    (tmp_path / "Load1.frd").write_text("damaged")  # another file is what is compared
    assert early_end(tmp_path / f"Load1{ending}") == ("was not completed (Load1.sta)", True)
    status.write_text("  1  2  3  4  ---  ---  ---\n")
    assert early_end(tmp_path / f"Load1{ending}") is None
    (tmp_path / "Load1.log").write_text("F O R   B I O M E C H A N I C S\n")
    assert early_end(tmp_path / f"Load1{ending}") == ("has no end in its log (Load1.log)", True)


def test_a_run_that_failed_before_its_first_state_has_no_time(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "febio/tet4.xplt").read_bytes()
    at = 4
    while (head := struct.unpack_from("<II", whole, at))[0] != 0x02000000:  # a state
        at += 8 + head[1]
    (tmp_path / "Load1.xplt").write_bytes(whole[:at])
    (tmp_path / "Load1.log").write_text("E R R O R   T E R M I N A T I O N")
    assert early_end(tmp_path / "Load1.xplt") == ("ended with ERROR TERMINATION (Load1.log)", True)


def test_an_element_that_is_lost_from_a_calculix_result_is_missed(folder: Path, tmp_path: Path) -> None:
    text = (folder / "calculix/spring.frd").read_text()
    start, end = text.index(" -1", text.index("    3C")), text.index(" -1         2   11")
    (tmp_path / "Load1.frd").write_text(text[:start] + text[end:])
    with pytest.raises(ImageFileError, match=r"Load1\.frd, after line .* \(1 of 2 items\)"):
        read_mesh(tmp_path / "Load1.frd")


def test_a_time_that_is_no_number_is_refused(folder: Path, tmp_path: Path) -> None:
    text = (folder / "calculix/c3d4.frd").read_text()
    (tmp_path / "Load1.frd").write_text(text.replace("105 1.000000000", "105         inf"))
    with pytest.raises(ImageFileError, match=r"Load1\.frd: a head of results cannot be read \(inf is not a valid"):
        early_end(tmp_path / "Load1.frd")
    time = struct.pack("<IIf", 0x02010002, 4, 1.0)
    data = (folder / "febio/tet4.xplt").read_bytes()
    assert data.count(time) == 1
    (tmp_path / "Load1.xplt").write_bytes(data.replace(time, struct.pack("<IIf", 0x02010002, 4, np.nan)))
    with pytest.raises(ImageFileError, match=r"Load1\.xplt: .*nan is not a valid result value"):
        early_end(tmp_path / "Load1.xplt")


def test_without_log_and_deck_a_time_that_is_not_whole_or_a_file_without_its_end_is_doubted(
    folder: Path, tmp_path: Path
) -> None:
    for name in ("febio/fails.xplt", "calculix/incs.frd", "febio/tet4.xplt", "calculix/c3d4.frd"):
        alone = tmp_path / Path(name).name
        alone.write_bytes((folder / name).read_bytes())
        end = early_end(alone)
        assert (end is not None) == (name in EARLY)
        assert end is None or end.certain == name.endswith(".frd")  # which lacks its last line
    text = (folder / "calculix/c3d4.frd").read_text()
    (tmp_path / "Load1.frd").write_text(text.removesuffix(" 9999\n"))
    end = early_end(tmp_path / "Load1.frd")
    assert end == ("did not finish: its result has no last line (9999), and it stopped at time 1", True)
    cut = tmp_path / "tet4.xplt"
    cut.with_suffix(".log").write_text("F O R   B I O M E C H A N I C S\n===== beginning time step 5 : 1 =====\n")
    end = early_end(cut)
    assert end is not None
    assert end.certain
    assert "no termination message" in end.reason
    with cut.with_suffix(".log").open("a") as log:  # the end of a long log counts, and is all that is read
        log.write("a line of an iteration\n" * 20_000 + " N O R M A L   T E R M I N A T I O N\n")
    assert early_end(cut) is None


def test_a_binary_calculix_result_is_named_as_such_and_not_as_a_run_that_ended_early(
    folder: Path, tmp_path: Path
) -> None:
    """It has no last line, like the result of a run that failed."""
    binary = tmp_path / "Load1.frd"
    binary.write_bytes((folder / "calculix/binary.frd").read_bytes())
    with pytest.raises(ImageFileError, match=r"Load1\.frd: not a text file\. .*\*NODE FILE in place of \*NODE OUTPUT"):
        early_end(binary)


def test_a_long_log_is_not_read_whole(tmp_path: Path) -> None:
    log = tmp_path / "model.log"
    with log.open("wb") as sparse:
        sparse.write(b"F O R   B I O M E C H A N I C S")
        sparse.seek(1 << 31)
        sparse.write(b" N O R M A L   T E R M I N A T I O N\n")
    tracemalloc.start()
    told = _ends_of(log)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "N O R M A L" in told
    assert "B I O M E C H A N I C S" in told
    assert most < 1 << 20


@pytest.mark.parametrize(("name", "told"), [("tet15", True), ("tet10", False), ("hex27", False)])
def test_nodes_that_are_left_out_are_told(
    folder: Path, caplog: pytest.LogCaptureFixture, name: str, told: bool
) -> None:
    read_mesh(folder / f"febio/{name}.xplt")
    assert ("elements with 15 nodes are read as tetra10, by their first 10 nodes" in caplog.text) == told
