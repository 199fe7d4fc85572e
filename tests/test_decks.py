"""Decks for other solvers; where CalculiX is installed, it has our states for its solution."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError
from dvc.mesh import TetMesh
from fe.decks import write_calculix, write_febio
from fe.materials import Hencky, Material, NeoHooke, Ogden, Yeoh
from fe.plate import Plate
from fe.simulate import LoadStep, State, simulate
from tests.blocks import block

CCX = shutil.which("ccx")
needs_calculix = pytest.mark.skipif(CCX is None, reason="CalculiX (ccx, Debian's calculix-ccx) is not installed")


def slab(count: tuple[int, int, int] = (3, 4, 4)) -> TetMesh:
    box = block(count, (9.0, 16.0, 16.0), layers=3, wobble=0.15)
    fat = np.concatenate([box.regions["layer 1"], box.regions["layer 2"]])
    facets = {"bone": box.facets["x1"], "skin": box.facets["x0"]}
    return TetMesh(box.points_mm, box.cells, {"skin": box.regions["layer 0"], "fat": fat}, facets)


def states_of(mesh: TetMesh, laws: dict[str, Material], formulation: str) -> list[State]:
    loads = [LoadStep("pressed", 1.5), LoadStep("sheared", 1.5, 1.0)]
    return simulate(mesh, laws, Plate([-1, 0, 0], [0, 1, 0]), loads, formulation=formulation)


def calculix(deck: Path, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of all nodes and the total force on the plate, from the .dat file."""
    subprocess.run([str(CCX), deck.stem], cwd=deck.parent, check=True, capture_output=True, timeout=300)
    told = deck.with_suffix(".dat").read_text()
    last = told[told.rindex("displacements") :]
    rows = re.findall(r"^\s+(\d+)\s+(\S+E\S+)\s+(\S+E\S+)\s+(\S+E\S+)\s*$", last, re.MULTILINE)
    u = np.zeros((nodes, 3))
    for node, *values in rows:
        if int(node) <= nodes:
            u[int(node) - 1] = [float(v) for v in values]
    total = re.search(r"total force.*?\n\s*\n\s+(\S+)\s+(\S+)\s+(\S+)", told[told.rindex("total force") :])
    assert total is not None
    return u, np.array([float(v) for v in total.groups()])


@needs_calculix
@pytest.mark.parametrize(
    "fat",
    [NeoHooke.of(0.01, nu=0.3), Ogden.from_ansys(0.0034, 6.2, nu=0.3), Yeoh.of(0.005, 0.069, 1.967, nu=0.3)],
    ids=lambda m: m.law,
)
def test_calculix_finds_the_same_state(tmp_path: Path, fat: Material) -> None:
    # Compressible enough that a quadratic tetrahedron with and without a pressure of its own are nearly the same
    # element; at the slab's free edges, where stress is singular, they differ by 2 %.
    mesh, laws = slab((6, 8, 8)), {"skin": NeoHooke.of(0.1, nu=0.3), "fat": fat}
    state = states_of(mesh, laws, "P2")[-1]
    assert state.reached == 1.0
    deck = tmp_path / "sheared.inp"
    write_calculix(deck, mesh, laws, state, quadratic=True)
    u, force = calculix(deck, len(mesh.points_mm))
    size = np.abs(state.u_mm).max()
    assert size > 0.5
    assert np.sqrt(np.mean((u - state.u_mm) ** 2)) < 0.003 * size
    assert np.abs(u - state.u_mm).max() < 0.03 * size
    assert force == pytest.approx([1.5, 1.0, 0.0], abs=0.005 * np.hypot(1.5, 1.0))


def test_a_deck_holds_the_mesh_the_laws_and_the_supports(tmp_path: Path) -> None:
    mesh, laws = slab(), {"skin": Yeoh.of(0.265, 1.923), "fat": Ogden.from_ansys(0.0034, 6.2)}
    state = states_of(mesh, laws, "P1")[0]
    write_calculix(tmp_path / "a.inp", mesh, laws, state)
    told = (tmp_path / "a.inp").read_text()
    assert told.count("*ELEMENT, TYPE=C3D4,") == 2
    assert "*HYPERELASTIC, OGDEN, N=1\n0.01054, 6.2, " in told
    assert "*HYPERELASTIC, YEOH\n0.265, 1.923, 0, " in told
    assert "NBONE, 1, 3, 0." in told
    from dvc.meshfile import read_mesh

    again = read_mesh(tmp_path / "a.inp")
    assert again.tets is not None
    assert np.abs(again.tets.points_mm - mesh.points_mm).max() < 1e-9
    assert len(again.tets.cells) == len(mesh.cells)


def test_an_febio_deck_says_the_same(tmp_path: Path) -> None:
    from xml.etree import ElementTree

    mesh, laws = slab(), {"skin": Yeoh.of(0.265, 1.923), "fat": Ogden.from_ansys(0.0034, 6.2)}
    state = states_of(mesh, laws, "P1")[0]
    write_febio(tmp_path / "a.feb", mesh, laws, state, quadratic=True)
    root = ElementTree.parse(tmp_path / "a.feb").getroot()
    sections = ["Module", "Control", "Material", "Mesh", "MeshDomains", "MeshData", "Boundary", "LoadData", "Output"]
    assert [child.tag for child in root if isinstance(child.tag, str)] == sections
    fat = root.find("Material/material[@name='M2FAT']")
    assert fat is not None
    assert fat.get("type") == "Ogden"
    numbers = {name: float(fat.findtext(name) or "nan") for name in ("c1", "m1", "k")}
    assert numbers == pytest.approx({"c1": 2 * 0.01054, "m1": 6.2, "k": laws["fat"].bulk_modulus_mpa})
    assert Ogden.from_febio(numbers["c1"], numbers["m1"]).shear_modulus_mpa == pytest.approx(0.01054)
    count = sum(len(e) for e in root.findall("Mesh/Elements"))
    assert count == len(mesh.cells)
    assert all(len((e.text or "").split(",")) == 10 for e in root.iterfind("Mesh/Elements/elem"))
    plate = (root.findtext("Mesh/NodeSet[@name='plate']") or "").split(",")
    x = [float(n.text or "nan") for n in root.iterfind("MeshData/NodeData[@name='ux']/node")]
    assert len(x) == len(plate) > len(state.on_plate)
    assert x == pytest.approx([state.travel_mm[0]] * len(x))
    domains = {d.get("name"): d.get("mat") for d in root.iterfind("MeshDomains/SolidDomain")}
    assert domains == {"E1SKIN": "M1SKIN", "E2FAT": "M2FAT"}


def test_a_law_that_a_solver_does_not_have_is_refused(tmp_path: Path) -> None:
    mesh, laws = slab(), {"skin": NeoHooke.of(0.1), "fat": Hencky.of(0.02, nu=0.49)}
    state = states_of(mesh, laws, "P1")[0]
    with pytest.raises(InputError, match="no law that is linear in logarithmic strain"):
        write_calculix(tmp_path / "a.inp", mesh, laws, state)
    with pytest.raises(InputError, match="no FEBio deck is written for linear elastic"):
        write_febio(tmp_path / "a.feb", mesh, laws, state)
    assert list(tmp_path.iterdir()) == []
