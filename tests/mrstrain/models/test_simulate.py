"""`mrstrain simulate`: a mesh in; for each set and load a VTU file, tables and pictures out; refusals first."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from dvc.deformation.strain import StrainField
from dvc.errors import InputError, OutputError
from dvc.mesh import TetMesh
from dvc.own_files import read_rows
from fe import LoadStep, Plate, Problem, paths_of, published_names, read_tet_mesh, write_tet_mesh
from fe.figures import _along_plate
from fe.result import patch_volumes, volume_percentiles
from mrstrain.cli.app import app
from mrstrain.models.simulate import load_named, simulate as run
from tests.blocks import block
from tests.fe.test_mesh_names import abaqus, ansys
from tests.fe.test_plate_displacement import block_under_plate
from tests.fe.test_simulate import DOWN, FAT, PRESS, dome, nodal_forces, press
from tests.processes import ended_process

pytestmark = pytest.mark.usefixtures("in_this_process")
PLATE = ["--plate-normal", "-1", "0", "0", "--shear-direction", "0", "1", "0"]
MINE = """
[mine.fat]
law = "Ogden"
convention = "ansys"
mu_mpa = 0.0034
alpha = 6.2
nu = 0.4999
[mine.Skin]
law = "neo-Hooke"
mu_kpa = 200
nu = 0.4999
"""

SOFTENING = """
[soft.skin]
law = "neo-Hooke"
mu_kpa = 200
nu = 0.49
[soft.fat]
law = "Yeoh"
c10_kpa = 10
c20_kpa = -4
nu = 0.49
"""


@pytest.fixture
def mesh_file(tmp_path: Path) -> Path:
    write_tet_mesh(tmp_path / "dome.vtu", dome((3, 4, 4)), {})
    return tmp_path / "dome.vtu"


@pytest.mark.usefixtures("real_pictures")
def test_every_set_and_load_has_its_files(mesh_file: Path, tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(MINE)
    loads = ["--load", "Load3=2,1", "--load", "Load2=2", "--load", "Load1=4"]
    given = ["--set", "luboz", "--set", str(own), *loads, *PLATE, "--decks"]
    done = CliRunner().invoke(app, ["simulate", str(mesh_file), *given, "--out", str(tmp_path / "sim")])
    assert done.exit_code == 0, done.output
    for name in ("luboz", "mine"):
        folder = tmp_path / "sim" / name
        told = json.loads((folder / "simulation.json").read_text())
        assert list(told["outcome"]) == ["Load3", "Load2", "Load1"]  # as asked for
        assert set(told["parameters"]["laws"]) == {"fat", "skin"}
        assert told["outcome"]["Load3"]["plate_force_n"] == pytest.approx([2, 1, 0], abs=2e-3)
        assert [file["name"] for file in told["inputs"]["mesh"]] == ["dome.vtu", "dome.json"]
        hashed = [hashlib.sha256(mesh_file.with_suffix(end).read_bytes()).hexdigest() for end in (".vtu", ".json")]
        assert [file["sha256"] for file in told["inputs"]["mesh"]] == hashed
        assert [file["name"] for file in told["inputs"]["sets"]] == ["mine.toml"]
        assert "C3D10" in (folder / "Load3.inp").read_text()
        assert (folder / "slices.png").stat().st_size > 10_000
        assert (folder / "force_displacement.png").stat().st_size > 5_000
        assert {path.name for path in folder.glob("*.pdf")} == {"slices.pdf", "force_displacement.pdf"}
        drawn, steps = (read_rows(folder / f"{of}.csv") for of in ("force_displacement", "curve"))
        assert {row["load"] for row in drawn} == {"Load1", "Load2", "Load3"}
        for axis in ("normal", "shear"):
            for there, here in (
                (f"{axis}_displacement_mm", f"displacement_{axis}_mm"),
                (f"{axis}_force_n", f"force_{axis}_n"),
            ):
                kept = [float(row[here]) for row in steps]
                assert [float(row[there]) for row in drawn] == pytest.approx(kept, rel=1e-5, abs=1e-9)
        regions = np.genfromtxt(folder / "regions.csv", delimiter=",", names=True, dtype=None, encoding=None)
        assert len(regions) == 6
        assert (np.abs(regions["volume_change"]) < 0.02).all()
        skin, whole = regions["von_mises_p90_mpa"][regions["region"] == "skin"], regions["von_mises_p50_mpa"]
        assert (skin > 0.0005).all()  # stiff, and under load
        assert (regions["von_mises_p99_mpa"] >= regions["von_mises_p90_mpa"]).all()
        assert (whole < regions["von_mises_p90_mpa"]).all()
        curve = np.genfromtxt(folder / "curve.csv", delimiter=",", names=True, dtype=None, encoding=None)
        assert curve["force_normal_n"].max() == pytest.approx(4.0, abs=0.01)
        at = curve[-1]
        assert 40.0 < at["contact_area_mm2"] < 400.0  # of a dome of 20 mm x 20 mm
        assert at["contact_pressure_mpa"] == pytest.approx(at["force_normal_n"] / at["contact_area_mm2"])
        assert told["outcome"]["Load1"]["contact_area_mm2"] == pytest.approx(at["contact_area_mm2"])
        load3 = curve[curve["load"] == "Load3"]
        assert load3["force_shear_n"][0] == pytest.approx(0.0, abs=1e-3)  # begins where Load2 ended
        assert load3["force_normal_n"][0] == pytest.approx(2.0, abs=2e-3)
        load2, load3 = (meshio.read(folder / f"{load}.vtu") for load in ("Load2", "Load3"))
        assert load3.point_data["displacement_mm"][:, 1].max() > load2.point_data["displacement_mm"][:, 1].max() + 0.1
        F = load3.cell_data["F"][0].reshape(-1, 3, 3)
        strain = StrainField.from_gradient(F - np.eye(3))
        assert load3.cell_data["max_shear"][0] == pytest.approx(strain.max_shear, abs=1e-12)
        green = load3.cell_data["green_lagrange"][0].reshape(-1, 3, 3)
        assert green == pytest.approx(0.5 * (F.transpose(0, 2, 1) @ F - np.eye(3)), abs=1e-12)
        stress = load3.cell_data["cauchy_stress_mpa"][0].reshape(-1, 3, 3)
        bone = np.unique(read_tet_mesh(mesh_file).facets["bone"])
        forces = nodal_forces(read_tet_mesh(mesh_file), F, stress)
        assert forces[bone].sum(axis=0) == pytest.approx([-2.0, -1.0, 0.0], abs=2e-3)
        pressure = np.trace(stress, axis1=1, axis2=2) / 3.0
        assert load3.cell_data["pressure_mpa"][0] == pytest.approx(pressure, abs=1e-12)


def test_the_help_names_every_published_set() -> None:
    told = re.sub(r"[^\w,-]+", " ", CliRunner().invoke(app, ["simulate", "--help"], env={"COLUMNS": "200"}).output)
    for name in published_names():
        assert name.removesuffix("-as-published") in told, name


def test_a_plate_that_turns_says_so(mesh_file: Path, tmp_path: Path) -> None:
    given = ["--load", "a=1", "--load", "b=1,0.5mm", *PLATE, "--turns", "--pivot", "0", "12", "10", "--set", "luboz"]
    done = CliRunner().invoke(app, ["simulate", str(mesh_file), *given, "--out", str(tmp_path / "sim")])
    assert done.exit_code == 0, done.output
    told = json.loads((tmp_path / "sim" / "luboz" / "simulation.json").read_text())
    assert told["parameters"]["turns"] is True
    assert told["parameters"]["pivot_mm"] == [0.0, 12.0, 10.0]
    assert "free to rotate" in told["parameters"]["plate"]
    b = told["outcome"]["b"]
    assert b["plate_displacement_mm"][1] == pytest.approx(0.5)
    assert abs(b["plate_turn_deg"][2]) > 0.5
    assert np.abs(b["plate_moment_nmm"]).max() < 1e-2


def test_loads_that_cannot_be_reached_are_marked_in_every_file(mesh_file: Path, tmp_path: Path) -> None:
    loads = ["--load", "a=2", "--load", "b=2,300", "--load", "c=2,400"]
    out = tmp_path / "sim"
    done = CliRunner().invoke(app, ["simulate", str(mesh_file), "--set", "luboz", *loads, *PLATE, "--out", str(out)])
    said = " ".join(done.output.split())
    assert done.exit_code == 1, said
    assert re.search(r"luboz, b: ONLY \d+ % of the load was reached", said)
    assert "luboz: c was not tried" in said
    assert re.search(r"b: no equilibrium was found beyond \d+ % of the load, .*\(lowest det F 0\.\d+\)", said)
    told = json.loads((out / "luboz" / "simulation.json").read_text())["outcome"]
    reached = told["b"]["reached"]
    assert 0.0 < reached < 1.0
    assert told["b"]["plate_force_n"][1] == pytest.approx(300.0 * reached, rel=1e-6)
    rows = (out / "luboz" / "regions.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in rows if row.startswith("b,")] == [f"{reached:.4g}"] * 2
    # a second run leaves nothing of the first, and takes nothing that it did not write
    (out / "luboz" / "mine.csv").write_text("kept")
    begun = out / "luboz" / f".{ended_process()}.partial.a.vtu"
    begun.write_text("half")
    again = CliRunner().invoke(
        app, ["simulate", str(mesh_file), "--set", "luboz", "--load", "d=1", *PLATE, "--out", str(out)]
    )
    assert again.exit_code == 0, again.output
    assert [path.name for path in (out / "luboz").glob("*.vtu")] == ["d.vtu"]
    assert (out / "luboz" / "mine.csv").read_text() == "kept"
    assert not begun.exists()


def test_tissue_squeezed_beyond_its_law_is_told(mesh_file: Path, tmp_path: Path) -> None:
    told = {}
    for name in ("friedman", "luboz"):  # fat's bulk modulus 0.029 and 0.5 MPa; pressure 0.025 MPa over the whole face
        given = ["simulate", str(mesh_file), "--set", name, "--load", "a=10", *PLATE, "--out", str(tmp_path / name)]
        told[name] = " ".join(CliRunner().invoke(app, given).output.split())
    assert re.search(
        r"a: \d+\.\d % of fat is compressed below det F 0\.4\. .*its bulk modulus \(0\.029 MPa\)", told["friedman"]
    )
    assert "compressed below" not in told["luboz"]


def test_a_law_that_is_not_stable_at_the_strain_reached_is_told_and_ends_with_status_1(tmp_path: Path) -> None:
    write_tet_mesh(tmp_path / "block.vtu", block_under_plate(), {})
    (tmp_path / "soft.toml").write_text(SOFTENING)
    told = {}
    for travel in ("0.2mm", "1.4mm"):
        given = ["simulate", str(tmp_path / "block.vtu"), "--set", str(tmp_path / "soft.toml"), "--load", f"a={travel}"]
        told[travel] = CliRunner().invoke(app, [*given, *PLATE, "--out", str(tmp_path / travel)])
        outcome = json.loads((tmp_path / travel / "soft" / "simulation.json").read_text())
        assert outcome["outcome"]["a"]["reached"] == 1.0  # so it is the law alone that counts
        told[travel + " noted"] = outcome["notes"]
        begun = told[travel].output.split("plate displacement")[0]
        assert "soft: the material of fat is stable (rising stress) only at" in begun  # before anything is computed
    assert told["0.2mm"].exit_code == 0, told["0.2mm"].output
    assert told["1.4mm"].exit_code == 1, told["1.4mm"].output
    note = r"a: the material of fat violates Drucker stability in \d+\.\d % of its volume; .* smaller load\."
    assert re.search("soft: " + note, " ".join(told["1.4mm"].output.split()))
    assert any(re.fullmatch(note, line) for line in told["1.4mm noted"])
    assert "Drucker" not in told["0.2mm"].output
    loads, plate = (
        [LoadStep("a", normal_mm=1.4)],
        {"plate_normal": (-1.0, 0.0, 0.0), "shear_direction": (0.0, 1.0, 0.0)},
    )
    done = run(tmp_path / "block.vtu", out=tmp_path / "1.4mm", sets=[str(tmp_path / "soft.toml")], loads=loads, **plate)
    assert not done.complete
    assert not done.sets[0].timed_out  # more time would not help


def test_more_is_fixed_beside_the_bone_and_what_law_stands_in_is_told(tmp_path: Path) -> None:
    mesh = dome((3, 4, 4))
    regions = {"skin": mesh.regions["skin"], "fat": mesh.regions["fat"][::2], "muscle": mesh.regions["fat"][1::2]}
    cut = block((3, 4, 4), (10.0, 20.0, 20.0)).facets["y0"]
    facets = dict(mesh.facets) | {"cut": cut}
    write_tet_mesh(tmp_path / "dome.vtu", TetMesh(mesh.points_mm, mesh.cells, regions, facets), {})
    bone, cut = np.unique(facets["bone"]), np.unique(cut)
    (tmp_path / "mine.toml").write_text(MINE)
    moved = {}
    for name, fix in (("free", []), ("fixed", ["--fix", "CUT"])):
        given = ["--set", str(tmp_path / "mine.toml"), "--load", "a=1mm", *PLATE, *fix, "--out", str(tmp_path / name)]
        done = CliRunner().invoke(app, ["simulate", str(tmp_path / "dome.vtu"), *given])
        assert done.exit_code == 0, done.output
        moved[name] = np.abs(meshio.read(tmp_path / name / "mine" / "a.vtu").point_data["displacement_mm"])
        told = json.loads((tmp_path / name / "mine" / "simulation.json").read_text())
        assert told["parameters"]["fixed"] == ["bone", "cut"][: 1 + len(fix)]
        instead = "mine has no material for muscle; that of fat is used."
        assert instead in told["notes"]
        assert f"{instead}\nResults" in done.output
    assert moved["free"][bone].max() == moved["fixed"][bone].max() == moved["fixed"][cut].max() == 0.0
    assert moved["free"][cut].max() > 0.02
    assert moved["fixed"].max() == pytest.approx(1.0, abs=0.2)
    refused = CliRunner().invoke(app, ["simulate", str(tmp_path / "dome.vtu"), *PLATE, "--fix", "side", "--out", "x"])
    assert "no surface set 'side'; it has bone, skin, cut" in str(refused.exception)


@pytest.mark.parametrize("quadratic", [False, True], ids=["SOLID285 and C3D4H", "SOLID187 and C3D10"])
def test_meshes_of_ansys_and_abaqus_give_what_the_same_mesh_gives_as_vtu(
    mesh_file: Path, tmp_path: Path, quadratic: bool
) -> None:
    """Of cells with ten nodes the corners are taken."""
    ansys(tmp_path / "dome.cdb", dome((3, 4, 4)), quadratic=quadratic)
    abaqus(tmp_path / "dome.inp", dome((3, 4, 4)), quadratic=quadratic)
    told = {}
    for place in (mesh_file, tmp_path / "dome.cdb", tmp_path / "dome.inp"):
        out = tmp_path / place.suffix[1:]
        given = ["--set", "luboz", "--load", "a=1", *PLATE, "--out", str(out)]
        done = CliRunner().invoke(app, ["simulate", str(place), *given])
        assert done.exit_code == 0, done.output
        told[out.name] = json.loads((out / "luboz" / "simulation.json").read_text())["outcome"]["a"]
    for name in ("cdb", "inp"):
        assert told[name]["plate_displacement_mm"] == pytest.approx(told["vtu"]["plate_displacement_mm"], abs=1e-7)
        assert told[name]["nodes_on_plate"] == told["vtu"]["nodes_on_plate"]
    assert told["vtu"]["plate_displacement_mm"][0] > 0.5


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--set", "trebi"], "did you mean 'trebbi'"),
        (["--set", "luboz", "--set", "luboz"], "--set: each name may occur only once"),
        (["--load", "Load1"], "A load is written NAME=NORMAL"),
        (["--load", "../x=3"], "may have letters"),
        (["--load", "a=1", "--load", "a=2"], "Two loads are named 'a'; rename one"),
        (["--load", "a=1", "--load", "A=2"], "Two loads are named 'a' and 'A' (case is ignored)"),
        (["--load", "a=-1"], "must be above 0 N"),
        (["--load", "a=nan"], "A load is written NAME=NORMAL"),
        (["--load", "a=1,2,3"], "A load is written NAME=NORMAL"),
        (["--load", "a=1cm"], "A load is written NAME=NORMAL"),
        (["--load", "a=2mm", "--gap-mm", "3"], "must be above 3 mm (the gap)"),
        (["--slide", "--load", "a=1,1mm"], "cannot apply shear"),
        (["--plate-normal", "0", "0", "0"], "not all zero"),
        (["--slide", "--load", "a=1,1"], "cannot apply shear"),
    ],
)
def test_what_cannot_be_is_refused(mesh_file: Path, tmp_path: Path, given: list[str], said: str) -> None:
    plate = [] if "--plate-normal" in given else PLATE
    refused = CliRunner().invoke(app, ["simulate", str(mesh_file), *plate, *given, "--out", str(tmp_path / "sim")])
    assert isinstance(refused.exception, Exception)
    assert said in str(refused.exception)
    assert not (tmp_path / "sim").exists()


def test_loads_lie_on_paths_by_their_normal_force() -> None:
    loads = [load_named(text) for text in ("a=15,45", "b=140", "c=15", "d=15,12")]
    assert [[x.name for x in path] for path in paths_of(loads)] == [["c", "d", "a"], ["b"]]
    kinds = [load_named(text) for text in ("a=15", "b=15,8mm", "c=15,45", "d=15,4mm", "e=15mm")]
    assert [[x.name for x in path] for path in paths_of(kinds)] == [["a", "d", "b"], ["c"], ["e"]]
    both_ways = [load_named(text) for text in ("a=15", "b=15,12", "c=15,-12")]
    assert [[x.name for x in path] for path in paths_of(both_ways)] == [["a", "b"], ["c"]]
    with pytest.raises(InputError, match="At least one load is needed"):
        paths_of([])


def test_a_load_may_go_in_directions_of_its_own(mesh_file: Path, tmp_path: Path) -> None:
    loads = [LoadStep("pressed", 2.0), LoadStep("forth", 2.0, 1.0), LoadStep("aside", 2.0, 1.0)]
    plate = {"plate_normal": DOWN, "shear_direction": (0.0, 1.0, 0.0)}
    aside = (tuple(DOWN), (0.0, 0.0, -1.0))
    assert [[x.name for x in p] for p in paths_of(loads, {"aside": aside})] == [["pressed", "forth"], ["aside"]]
    again = ((-2.0, 0.0, 0.0), (0.0, 3.0, 0.0))  # the plate's own, written out
    done = run(
        mesh_file, out=tmp_path / "out", loads=loads, **plate, towards={"aside": aside, "forth": again}, threads=1
    ).sets[0]
    there = {state.load.name: state for state in done.states}
    alone = {"plate_normal": DOWN, "shear_direction": aside[1]}
    only = run(mesh_file, out=tmp_path / "only", loads=loads[2:], **alone, threads=1).sets[0].states[0]
    assert np.abs(there["aside"].u_mm - only.u_mm).max() < 1e-9
    assert np.abs(there["aside"].u_mm - there["forth"].u_mm).max() > 0.5 * np.abs(only.u_mm).max()
    force = there["aside"].plate_axes @ there["aside"].force_n
    assert force == pytest.approx(-2.0 * np.array(DOWN) + [0.0, 0.0, -1.0], abs=5e-3)
    told = json.loads((tmp_path / "out" / done.name / "simulation.json").read_text())
    assert [[load["name"] for load in path] for path in told["parameters"]["paths"]] == [
        ["pressed", "forth"],
        ["aside"],
    ]
    told = told["outcome"]
    assert np.array(told["aside"]["plate_axes_lps"])[:, 1].tolist() == [0.0, 0.0, -1.0]
    assert np.array(told["forth"]["plate_axes_lps"])[:, 1].tolist() == [0.0, 1.0, 0.0]
    with pytest.raises(InputError, match="Load9, which is no load; the loads are "):
        run(mesh_file, out=tmp_path / "no", loads=loads, **plate, towards={"Load9": aside})


def test_a_plate_that_nobody_placed_is_said_to_be_inferior(tmp_path: Path) -> None:
    place, load, notes = tmp_path / "luboz" / "dome.vtu", LoadStep("Load1", 2.0), list[str]()
    place.parent.mkdir()
    write_tet_mesh(place, dome((3, 4, 4)), {})

    def told(case: str, stage: str, _: float) -> None:
        notes.extend([stage] * (case == "note"))

    def simulated(**more: Any) -> list[str]:
        notes.clear()
        with pytest.raises(OutputError):  # the mesh would be replaced; the plate is told before
            run(place, out=tmp_path, sets=["luboz"], loads=[load], progress=told, **more)
        return [note for note in notes if "plate" in note]

    inferior = (
        "The plate is taken to be inferior to the body (normal 0 0 -1, LPS). If it lies elsewhere, give plate_normal "
        "(--plate-normal)."
    )
    assert simulated() == [inferior]
    assert simulated(plate_normal=DOWN) == simulated(plate_normal=(0.0, 0.0, -1.0)) == []
    assert simulated(towards={"Load1": (DOWN, (0.0, 1.0, 0.0))}) == []


def test_the_dashed_line_lies_on_the_tissue_that_a_plate_from_elsewhere_presses() -> None:
    """In the slice of another load; a plate along the slice is left out."""
    state = press(dome((3, 4, 4)), PRESS)[0]
    mesh, tilted = dome((3, 4, 4)), Rotation.from_rotvec([0.0, 0.0, 20.0], degrees=True).as_matrix()
    axes = tilted @ state.plate_axes
    height, slope = _along_plate(mesh, state, axes, np.zeros(3))
    on_plate = (mesh.points_mm + state.u_mm)[state.on_plate] @ axes
    assert on_plate[:, 0] == pytest.approx(height + slope * on_plate[:, 1], abs=1e-6)
    assert abs(slope) == pytest.approx(np.tan(np.radians(20.0)))
    assert _along_plate(mesh, state, state.plate_axes[:, [1, 0, 2]], np.zeros(3)) is None


def test_the_area_under_the_plate_is_that_of_its_faces() -> None:
    mesh = block_under_plate()
    bound = LoadStep("in", normal_mm=0.5)
    state = press(mesh, [bound])[0]
    assert state.plate.area_mm2 == pytest.approx(400.0)  # taped, so as wide as it was
    assert state.plate.pressure_mpa == pytest.approx(state.force_n[0] / 400.0)


def test_patches_and_percentiles() -> None:
    mesh = dome((3, 4, 4))
    assert patch_volumes(mesh, np.full(len(mesh.cells), 1.02)) == pytest.approx(1.02)
    assert volume_percentiles(np.array([3.0, 1.0, 2.0]), np.array([1.0, 8.0, 1.0]), (0.5, 0.85, 0.99)) == (
        1.0,
        2.0,
        3.0,
    )


def test_the_mesh_may_come_from_elsewhere(tmp_path: Path) -> None:
    mesh = dome((3, 4, 4))
    lines = ["*NODE"] + [f"{n}, {x}, {y}, {z}" for n, (x, y, z) in enumerate(mesh.points_mm.tolist(), start=1)]
    for name, cells in mesh.regions.items():
        lines += [f"*ELEMENT, TYPE=C3D4H, ELSET={name}"]
        lines += [f"{c + 1}, " + ", ".join(str(n + 1) for n in mesh.cells[c]) for c in cells]
    everything = ", ".join(str(c + 1) for c in range(len(mesh.cells)))
    lines += ["*ELSET, ELSET=EALL", *_rows(everything)]
    (tmp_path / "dome.inp").write_text("\n".join(lines) + "\n")
    read = read_tet_mesh(tmp_path / "dome.inp")  # the set of all elements is left out
    assert set(read.regions) == {"fat", "skin"}
    with pytest.raises(InputError, match="no surface set 'bone'; it has none"):
        Problem(read, {"fat": FAT, "skin": FAT}, Plate(DOWN, [0.0, 1.0, 0.0]), [LoadStep("a", 1.0)])


def _rows(numbers: str) -> list[str]:
    each = numbers.split(", ")
    return [", ".join(each[start : start + 16]) + "," for start in range(0, len(each), 16)]
