"""A simulation as an object: its arrays, its files and back, its picture and its words."""

import base64
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import fe
from dvc.deformation.protocol import Deformation
from dvc.errors import InputError
from tests.fe.solving import Notebook
from tests.fe.test_simulate import ALONG, DOWN, FAT, LAWS, dome

LOADS = [fe.LoadStep("pressed", 2.0), fe.LoadStep("sheared", 2.0, 1.0), fe.LoadStep("in", normal_mm=1.0)]
WEAK = {"skin": fe.NeoHooke.of(0.067, nu=0.495), "fat": fe.NeoHooke.of(0.01, nu=0.49)}


@pytest.fixture(scope="module")
def simulation() -> fe.Simulation:
    sets = fe.MaterialSet("mine", "Ours", "measured & fitted", LAWS)
    return fe.simulate(dome((3, 4, 4)), sets, fe.Plate(DOWN, ALONG, turns=True), LOADS, fixed=("bone",))


@pytest.fixture(scope="module")
def unreached() -> fe.Simulation:
    loads = [LOADS[0], fe.LoadStep("far & too much", 2.0, 300.0), fe.LoadStep("never", 2.0, 400.0)]
    return fe.simulate(dome((3, 4, 4)), WEAK, fe.Plate(DOWN, ALONG), loads)


def test_it_holds_displacement_strain_stress_and_forces_as_arrays(simulation: fe.Simulation) -> None:
    cells = len(simulation.mesh.cells)
    assert [[load.name for load in path] for path in simulation.paths] == [["pressed", "sheared"], ["in"]]
    assert simulation.complete
    state = simulation.state("sheared")
    assert state.force_n == pytest.approx([2.0, 1.0, 0.0], abs=2e-3)
    assert state.u_mm.shape == simulation.mesh.points_mm.shape
    assert simulation.cauchy_stress("sheared").shape == state.strain.green_lagrange.shape == (cells, 3, 3)
    assert simulation.state("in").plate_displacement_mm[0] == pytest.approx(1.0)
    field = simulation.deformation("sheared")
    assert isinstance(field, Deformation)
    u, H = field.evaluate(simulation.mesh.centroids_mm)
    assert np.abs(u - state.u_mm[simulation.mesh.cells].mean(axis=1)).max() < 1e-12
    assert np.abs(H - state.gradients).max() < 1e-9
    with pytest.raises(InputError, match="No load 'Sheared' was simulated; simulated loads: pressed, sheared, in"):
        simulation.state("Sheared")


@pytest.mark.parametrize("with_mesh", [True, False])
def test_it_comes_back_from_its_folder_as_it_was(simulation: fe.Simulation, tmp_path: Path, with_mesh: bool) -> None:
    simulation.write(tmp_path)
    read = fe.Simulation.read(tmp_path, simulation.mesh if with_mesh else None)
    assert (read.name, read.materials.source, read.element, read.turns) == ("mine", "measured & fitted", "P1", True)
    assert (read.paths, read.fixed) == (simulation.paths, ("bone",))
    assert (read.notes, read.complete) == (simulation.notes, True)
    for was, state in zip(simulation.states, read.states, strict=True):
        assert np.array_equal(state.u_mm, was.u_mm)
        assert np.array_equal(state.pressure_mpa, was.pressure_mpa)
        assert np.abs(state.gradients - was.gradients).max() < 1e-15
        assert state.on_plate.tolist() == sorted(was.on_plate)
        assert state.plate.turn_deg.tolist() == was.plate.turn_deg.tolist()
        assert state.plate.moment_nmm.tolist() == was.plate.moment_nmm.tolist()
        assert len(state.curve) == len(was.curve)
        assert state.curve[1].force_n == pytest.approx(was.curve[1].force_n, rel=1e-7, abs=1e-7)
    for region, material in simulation.materials.materials.items():
        again = read.materials.materials[region]
        assert type(again) is type(material)
        assert again.bulk_modulus_mpa == pytest.approx(material.bulk_modulus_mpa, rel=1e-9)
        assert (again.vector.tolist(), str(again.description)) == (material.vector.tolist(), material.description)
        assert set(read.mesh.facets) == {"bone", "skin"}
        assert np.array_equal(np.unique(read.mesh.facets["bone"]), np.unique(simulation.mesh.facets["bone"]))
    (tmp_path / "again").mkdir()
    read.write(tmp_path / "again")
    assert (tmp_path / "again" / "regions.csv").read_text() == (tmp_path / "regions.csv").read_text()
    curve, was = (
        np.genfromtxt(folder / "curve.csv", delimiter=",", skip_header=1, usecols=range(1, 15))
        for folder in (tmp_path / "again", tmp_path)
    )
    assert curve == pytest.approx(was, rel=1e-7, abs=1e-12, nan_ok=True)
    assert str(read) == str(simulation)


def test_what_is_odd_is_told_before_anything_is_solved_and_noted() -> None:
    heard = Notebook()
    loads, odd = [fe.LoadStep("a", 500.0)], {"skin": fe.NeoHooke.of(0.2), "fat": fe.Yeoh.of(0.005, -0.005)}
    given = dome((2, 2, 2)), odd, fe.Plate(DOWN, ALONG), loads
    done = fe.simulate(*given, options=fe.SolverOptions(limit_s=0.0), observer=heard)
    assert "fat is stable (rising stress) only at" in heard.lines[0]
    assert heard.lines[1].startswith("The force of a, 500 N, is a pressure of 1.25 MPa")
    assert done.notes[:2] == tuple(heard.lines[:2])


def test_names_of_older_files_are_known(simulation: fe.Simulation, tmp_path: Path) -> None:
    simulation.write(tmp_path)
    for file, now, before in (
        ("simulation.json", "plate_displacement_mm", "plate_travel_mm"), ("curve.csv", "displacement_", "travel_"),
    ):  # fmt: skip
        text = (tmp_path / file).read_text()
        assert now in text
        (tmp_path / file).write_text(text.replace(now, before))
    for was, state in zip(simulation.states, fe.Simulation.read(tmp_path).states, strict=True):
        assert state.plate_displacement_mm.tolist() == was.plate_displacement_mm.tolist()
        assert state.curve[1].displacement_mm == pytest.approx(was.curve[1].displacement_mm, rel=1e-7, abs=1e-7)


def test_what_was_not_reached_comes_back_and_is_marked_everywhere(unreached: fe.Simulation, tmp_path: Path) -> None:
    share = unreached.state("far & too much").reached
    assert 0.0 < share < 1.0
    assert not unreached.complete
    unreached.write(tmp_path)
    read = fe.Simulation.read(tmp_path)
    assert (read.complete, read.timed_out) == (False, False)
    assert read.state("far & too much").reached == share
    moved = read.state("far & too much").plate_displacement_mm[0]
    assert f"far & too much {moved:.1f}" in unreached.headline
    assert unreached.headline == read.headline
    assert unreached.headline.endswith(f" (ONLY {100 * share:.0f} % of the load)")
    for words in (str(unreached), str(read)):
        assert f"far & too much: ONLY {100 * share:.0f} % of the load was reached" in words
        assert "never was not tried" in words
    shown = unreached._repr_html_()
    assert "1 of 3 loads reached" in shown
    assert "far &amp; too much" in shown
    assert "far & too" not in shown


@pytest.mark.usefixtures("real_pictures")
def test_a_notebook_shows_a_picture_and_a_table(simulation: fe.Simulation) -> None:
    shown = simulation._repr_html_()
    assert "mine: 3 of 3 loads reached" in shown
    assert shown.count("<tr>") == 1 + len(LOADS)
    state, row = simulation.state("sheared"), next(r for r in simulation.regions if r.load == "sheared")
    cells = re.findall(r"<td[^>]*>(.*?)</td>", shown)
    assert {f"{v:.2f}" for v in state.plate_displacement_mm[:2].round(2)} <= set(cells)
    assert f"{row.shear_p50:.3f} / {row.shear_p95:.3f}" in cells
    picture = re.search(r"data:image/png;base64,([^\"]+)", shown)
    assert picture
    pixels = imread(io.BytesIO(base64.b64decode(picture[1])))
    assert len(np.unique(pixels.reshape(-1, pixels.shape[2]), axis=0)) > 50


def test_its_plot_has_a_panel_for_each_load(simulation: fe.Simulation) -> None:
    titles = [axes.get_title() for axes in simulation.plot().axes]
    assert [t.split(":")[0] for t in titles if t] == ["pressed", "sheared", "in"]
    (one,) = [axes for axes in simulation.plot(["sheared"]).axes if axes.get_title()]
    assert one.get_title() == "sheared: 2 N normal, 1 N shear"
    (cells,) = [c for c in one.collections if c.get_array() is not None]
    assert cells.get_array().max() <= simulation.state("sheared").strain.max_shear.max()
    assert cells.get_array().max() > 0.1


def test_what_is_no_simulation_is_refused(simulation: fe.Simulation, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"not the folder of a simulation.*folder with simulation\.json, curve\.csv and a VTU"
    ):
        fe.Simulation.read(tmp_path)
    simulation.write(tmp_path)
    with pytest.raises(InputError, match="made on another mesh than the one given"):
        fe.Simulation.read(tmp_path, dome((2, 2, 2)))
    curves = (tmp_path / "curve.csv").read_text()
    (tmp_path / "curve.csv").write_text(curves + '"')
    with pytest.raises(InputError, match=r"not the folder of a simulation, or a file in it is damaged .*curve\.csv"):
        fe.Simulation.read(tmp_path)
    (tmp_path / "curve.csv").write_text(curves)
    told = json.loads((tmp_path / "simulation.json").read_text())
    del told["outcome"]["in"]["plate_force_n"]
    (tmp_path / "simulation.json").write_text(json.dumps(told))
    with pytest.raises(InputError, match="KeyError: 'plate_force_n'"):
        fe.Simulation.read(tmp_path)


def test_notes_of_earlier_versions_are_shown_once(unreached: fe.Simulation, tmp_path: Path) -> None:
    """They are derived from the states, in the words of today, and only what was assumed is taken from the file."""
    replace(unreached, remarks=("weak has no material for tendon; that of fat is used.",)).write(tmp_path)
    record = json.loads((tmp_path / "simulation.json").read_text())
    record["notes"] += ["never was not tried: another wording.", "pressed: det F is off what the law asks for."]
    (tmp_path / "simulation.json").write_text(json.dumps(record))
    notes = fe.Simulation.read(tmp_path).notes
    assert notes == ("weak has no material for tendon; that of fat is used.", *unreached.notes)


def test_a_damaged_file_is_refused_by_its_name(simulation: fe.Simulation, tmp_path: Path) -> None:
    simulation.write(tmp_path)
    place = tmp_path / "pressed.vtu"
    whole = place.read_bytes()
    end = whole.rindex(b"</DataArray>") - 40
    for damaged in (whole[:end] + whole[end + 8 :], whole[: len(whole) // 2], b""):
        place.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a file in it is damaged \(ValueError: pressed\.vtu: "):
            fe.Simulation.read(tmp_path)


@pytest.mark.parametrize("lost", ["region_numbers_in_vtu", "laws"])
def test_a_record_that_lacks_a_region_is_refused(simulation: fe.Simulation, tmp_path: Path, lost: str) -> None:
    simulation.write(tmp_path)
    record = json.loads((tmp_path / "simulation.json").read_text())
    record["parameters"][lost].popitem()
    (tmp_path / "simulation.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"only the mesh or only the materials have the region (fat|skin)"):
        fe.Simulation.read(tmp_path)


def test_a_record_of_a_material_that_was_cut_is_refused(simulation: fe.Simulation, tmp_path: Path) -> None:
    simulation.write(tmp_path)
    record = json.loads((tmp_path / "simulation.json").read_text())
    del record["parameters"]["laws"]["fat"]["vector_mpa"][2:]
    (tmp_path / "simulation.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="a file in it is damaged"):
        fe.Simulation.read(tmp_path)


def test_folders_are_made_and_names_taken_as_text(simulation: fe.Simulation, tmp_path: Path) -> None:
    simulation.write(tmp_path / "a" / "b", fields=False)
    simulation.write_decks(str(tmp_path / "decks"))
    assert (tmp_path / "a" / "b" / "simulation.json").is_file()
    assert (tmp_path / "decks" / "pressed.feb").is_file()
    fe.write_state(str(tmp_path / "state.vtu"), simulation.mesh, simulation.states[0], LAWS)
    fe.write_regions_csv(str(tmp_path / "rows.csv"), simulation.regions)
    (tmp_path / "file").touch()
    with pytest.raises(fe.OutputError, match=r"file.c: cannot be|file.regions\.csv: cannot be written"):
        simulation.write(tmp_path / "file", fields=False)


def test_materials_may_be_given_by_region_or_by_the_name_of_their_set() -> None:
    soft, given = {"skin": FAT, "fat": FAT}, (fe.Plate(DOWN, ALONG), [fe.LoadStep("a", normal_mm=0.2)])
    done = fe.simulate(dome((2, 3, 3)), soft, *given)
    assert done.complete
    assert done.materials.materials == soft
    named = fe.simulate(dome((2, 3, 3)), "luboz", *given)
    assert (named.name, named.complete) == ("luboz", True)


@pytest.mark.parametrize(
    ("argument", "given", "said"),
    [
        (0, "heel.vtu", r"^mesh must be a TetMesh, from fe\.read_tet_mesh\(file\) .*; got 'heel\.vtu'"),
        (0, np.zeros((4, 3)), r"^mesh must be a TetMesh.*; got ndarray of shape \(4, 3\)"),
        (1, "trebi", "Unknown material set 'trebi'; did you mean 'trebbi'"),
        (1, {"fat": "trebbi"}, r"^materials\['fat'\] must be a material, such as fe\.Ogden.*; got 'trebbi'"),
        (1, 0.0034, r"^materials must be a material set, .*fe\.material_set.*; got 0.0034"),
        (2, (DOWN, ALONG), r"^plate must be a fe\.Plate, .*; got tuple"),
        (2, {"other": fe.Plate(DOWN, ALONG)}, "no plate for pressed; it has one for other"),
        (3, LOADS[0], r"^loads must be a list, each item a fe\.LoadStep.*; got LoadStep"),
        (3, [{"name": "pressed", "normal_n": 2.0}], r"^loads\[0\] must be a fe\.LoadStep.*; got dict"),
        (3, "pressed", "^loads must be a list.*; got 'pressed'"),
    ],
)
def test_what_is_of_another_kind_is_refused_with_what_to_give(argument: int, given: object, said: str) -> None:
    arguments: list[object] = [dome((2, 3, 3)), LAWS, fe.Plate(DOWN, ALONG), LOADS[:1]]
    arguments[argument] = given
    with pytest.raises(InputError, match=said):
        fe.simulate(*arguments)  # type: ignore[arg-type]


def test_a_new_simulation_removes_the_figures_of_an_older_version_too(tmp_path: Path) -> None:
    old, foreign = tmp_path / "force_travel.png", tmp_path / "notes.csv"
    for path in (old, tmp_path / "force_displacement.csv", foreign):
        path.touch()
    fe.begin_simulation(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.csv", "simulation.json"]
