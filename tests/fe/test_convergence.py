"""Extrapolation gives back a known limit and order; `converge` makes meshes, loads and table, and keeps its meshes."""

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.errors import InputError
from dvc.images.image import LabelMap
from dvc.io.images.write import write_labels
from fe import extrapolate, write_tet_mesh
from mrstrain.cli.app import app
from mrstrain.models.converge import _is_of
from mrstrain.options.modelling import Labelling, Meshing
from mrstrain.records.provenance import provenance
from tests.fe.test_meshing import half_onion
from tests.fe.test_simulate import dome


@pytest.mark.parametrize("order", [0.8, 1.0, 2.0])
def test_a_known_order_and_limit(order: float) -> None:
    h = np.array([5.0, 3.0, 2.0, 1.5])
    found = extrapolate(h, 7.0 - 0.2 * h**order)
    assert found.limit == pytest.approx(7.0, abs=0.01)
    assert found.order == pytest.approx(order, abs=0.03)
    assert found.error == pytest.approx(-0.2 * 1.5**order / 7.0, rel=0.05)


def test_what_seems_to_converge_faster_than_it_can_is_not_called_converged() -> None:
    """The plate's travel on a heel, as `converge` found it: the last two meshes agree by chance."""
    h, travel = np.array([1.36, 1.12, 0.87, 0.70]), np.array([10.2547, 10.3734, 10.4355, 10.4373])
    found = extrapolate(h, travel)
    assert found.order == 2.0
    assert found.limit == pytest.approx(10.526, abs=0.002)
    assert found.error == pytest.approx(-0.0084, abs=0.0003)  # a hundred times what the last two differ by
    cubic = extrapolate(h, 7.0 - 0.2 * h**3)
    assert cubic.order == 2.0
    assert abs(cubic.error) > 0.2 * 0.7**3 / 7.0


def test_a_limit_that_is_passed_already_is_none() -> None:
    h, f = np.array([2.02, 1.73, 0.82, 0.71]), np.array([0.15, 1.68, 2.21, 3.63])  # steady, but scattered
    assert np.isnan(extrapolate(h, f).limit)


def test_no_limit_is_told_where_there_is_none() -> None:
    h = np.array([5.0, 4.0, 3.0, 2.0])
    found = extrapolate(h, np.array([1.0, 1.2, 0.9, 1.1]))
    assert found.scatter > 0.05
    assert np.isnan(found.limit)
    assert np.isnan(extrapolate(h[1:], np.array([1.0, 1.1, 1.3])).limit)  # runs away: an order below 0.5
    for sizes in (h[:2], np.array([2.0, 1.9, 1.8])):
        with pytest.raises(
            InputError, match=r"at least 3 meshes of different cell size, the coarsest at least 1\.5 times"
        ):
            extrapolate(sizes, sizes)


@pytest.mark.usefixtures("in_this_process")
def test_meshes_are_made_once_and_simulated_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With blocks in the place of the mesher's tetrahedra."""
    counts, made = {6.0: (3, 4, 4), 4.0: (4, 6, 6), 2.5: (5, 8, 8)}, []

    def block_of(labels: Path, *, out: Path, labelling: Labelling, meshing: Meshing, **_: object) -> None:
        inputs = {"labels": Path(labels), "names": Path(labelling.names)}
        write_tet_mesh(out, dome(counts[meshing.edge_mm]), provenance("mesh", inputs, {"bones": list(labelling.bones)}))
        made.append(meshing.edge_mm)

    monkeypatch.setattr("mrstrain.models.converge.make_mesh", SimpleNamespace(with_options=block_of))
    write_labels(tmp_path / "map.nii.gz", half_onion())
    given = [text for edge in counts for text in ("--edge-mm", str(edge))]
    given += ["--names", str(tmp_path / "map.csv"), "--load", "pressed=1", "--set", "luboz"]
    given += ["--plate-normal", "-1", "0", "0", "--shear-direction", "0", "1", "0", "--out", str(tmp_path / "study")]
    done, again = (CliRunner().invoke(app, ["converge", str(tmp_path / "map.nii.gz"), *given]) for _ in range(2))
    assert done.exit_code == again.exit_code == 0, done.output + again.output
    assert made == sorted(counts, reverse=True)
    with (tmp_path / "study" / "convergence.csv").open(newline="") as file:
        travel, *_, sizes = csv.DictReader(file)
    assert (sizes["load"], sizes["quantity"], sizes["limit"]) == ("all", "size of the cells, mm", "")
    assert float(sizes["edge_6_mm"]) > 0.0
    assert travel["quantity"] == "plate displacement, mm"
    values = [float(travel[f"edge_{edge:g}_mm"]) for edge in counts]
    assert values == sorted(values)  # finer meshes are softer
    assert len(set(values)) == 3
    assert again.output.splitlines()[-6:] == done.output.splitlines()[-6:]
    inputs = {"labels": [tmp_path / "map.nii.gz"], "names": [tmp_path / "map.csv"]}
    mesh = tmp_path / "study" / "mesh-6.vtu"
    assert _is_of(mesh, inputs, ["bone"])
    assert not _is_of(mesh, inputs, ["bone", "fat"])  # with another bone cut out it is another mesh


@pytest.mark.full_size
def test_the_command(tmp_path: Path) -> None:
    onion = half_onion()
    plain = LabelMap(onion.grid, np.where(onion.labels == 3, 2, onion.labels), {1: "bone", 2: "fat"})  # nothing thin
    write_labels(tmp_path / "map.nii.gz", plain)
    sizes = [text for edge in ("5.0", "2.6", "1.6") for text in ("--edge-mm", edge)]
    given = [*sizes, "--names", str(tmp_path / "map.csv"), "--load", "pressed=3", "--set", "luboz"]
    out = tmp_path / "study"
    done = CliRunner().invoke(app, ["converge", str(tmp_path / "map.nii.gz"), *given, "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "Cell sizes, mm" in done.output
    with (out / "convergence.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["quantity"] for row in rows][:2] == ["plate displacement, mm", "maximum shear strain of fat, p50"]
    assert 0.1 < float(rows[0]["edge_1.6_mm"]) < 10.0
    for ending in ("png", "pdf"):
        assert any(row["limit"] for row in rows) == (out / f"convergence.{ending}").is_file()
    before = (out / "mesh-2.6.vtu").read_bytes()
    again = CliRunner().invoke(app, ["converge", str(tmp_path / "map.nii.gz"), *given, "--out", str(out)])
    assert again.exit_code == 0
    assert (out / "mesh-2.6.vtu").read_bytes() == before  # the mesher is not deterministic: it was not asked again
    assert again.output.splitlines()[-6:] == done.output.splitlines()[-6:]


def test_a_misspelt_set_or_region_is_refused_before_meshing(tmp_path: Path) -> None:
    from mrstrain.models.converge import converge

    write_labels(tmp_path / "map.nii.gz", half_onion())
    for wrong, said in (
        ({"material": "trebi"}, "did you mean 'trebbi'"),
        ({"region": "fatt"}, "no soft tissue 'fatt'"),
    ):
        with pytest.raises(InputError, match=said):
            converge(
                tmp_path / "map.nii.gz", [6.0, 4.0, 2.0], names=tmp_path / "map.csv", out=tmp_path / "out", **wrong
            )
    assert not list((tmp_path / "out").glob("*.vtu"))


def test_two_sizes_are_too_few(tmp_path: Path) -> None:
    from mrstrain.models.converge import converge

    with pytest.raises(InputError, match="at least 3 different edge lengths; got 2"):
        converge("map.nii.gz", [4.0, 2.0], out=tmp_path)
