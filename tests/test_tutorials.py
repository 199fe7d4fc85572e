"""Every tutorial and page on Python does what it says, from its first block to its last, and so is what it asserts."""

from __future__ import annotations

import pkgutil
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import typer
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser

import fe
from dvc import Grid, Image, StrainField, read_image
from dvc.io.images.labels import read_labels
from dvc.io.images.write import write_image, write_mask
from fe import read_material_sets
from mrstrain.cli.app import app
from mrstrain.measurement.strokes import read_marks
from mrstrain.studies.file import read_study
from mrstrain.truth.phantom import phantom
from phantoms import Heel, under_load
from tests.quick import QUICK

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
GIVEN = ROOT / "tests" / "golden" / "given"
PAGES = sorted([ROOT / "README.md", *DOCS.rglob("*.md")])
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def follow(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Run the Python blocks of a page one after the other in a folder; the names that they leave."""
    monkeypatch.chdir(folder)
    document = Sybil(parsers=[PythonCodeBlockParser()]).parse(DOCS / page)
    examples = list(document.examples())
    assert examples, f"{page} has no Python block"
    assert any("assert" in example.parsed for example in examples), f"{page} asserts nothing"
    for example in examples:
        example.evaluate()
    return document.namespace


def quick_phantom(folder: Path, seed: int) -> Path:
    """A phantom heel with large voxels under Load1, and parameters that register it in seconds."""
    phantom(folder, seed=seed, loads=["Load1"], spacing_mm=1.6)
    (folder / "quick.txt").write_text(QUICK)
    return folder


def copy_scans(folder: Path) -> None:
    """A small heel without load, under Load1, and without load again, with a mask of its bone."""
    for name in ("Load0", "Load1", "Load0-again"):
        shutil.copy(GIVEN / f"{name}.nii.gz", folder)
    bone = read_labels(GIVEN / "tissues.nii.gz", GIVEN / "tissues.csv").region("bone")
    write_mask(folder / "calcaneus.nii.gz", bone)


def write_model(heel: Path, folder: Path, seed: int, share: float) -> None:
    """A model of bricks as Abaqus writes it, in metres and RAS, that moves by a share of what the phantom does."""
    labels = read_labels(heel / "tissues.nii.gz", heel / "tissues.csv")
    bones = [number for number, name in labels.names.items() if name in ("bone", "ankle")]
    values = labels.labels
    # Bricks two voxels long, from voxel centre to voxel centre; all corners in the heel.
    first = np.argwhere(values[:-2:2, :-2:2, :-2:2] > 0) * 2
    inside = (values[tuple((first[:, None, :] + 2 * CORNERS).T)] > 0).all(axis=0)
    middle = values[tuple((first + 1).T)]
    kept = inside & (middle > 0) & ~np.isin(middle, bones)
    first, tissue = first[kept], middle[kept]
    corners, which = np.unique((first[:, None, :] + 2 * CORNERS).reshape(-1, 3), axis=0, return_inverse=True)
    points = labels.grid.points_at(corners.astype(np.float64))
    u = share * under_load(Heel(seed), "Load1").displacement(points)
    to_file = np.array([-1e-3, -1e-3, 1e-3])
    folder.mkdir()
    lines = ["*HEADING", "a heel", "*NODE"]
    lines += [f"{n}, {x!r}, {y!r}, {z!r}" for n, (x, y, z) in enumerate((points * to_file).tolist(), start=1)]
    bricks = which.reshape(-1, 8) + 1
    for number, name in labels.names.items():
        of = np.flatnonzero(tissue == number)
        if len(of):
            lines += [f"*ELEMENT, TYPE=C3D8, ELSET={name}"]
            lines += [f"{cell + 1}, " + ", ".join(map(str, bricks[cell])) for cell in of]
    (folder / "heel.inp").write_text("\n".join(lines) + "\n")
    rows = [f"{n}, {x!r}, {y!r}, {z!r}" for n, (x, y, z) in enumerate((u * to_file).tolist(), start=1)]
    (folder / "Load1.csv").write_text("\n".join(["Node Label, U-U1, U-U2, U-U3", *rows]) + "\n")


@pytest.fixture(scope="module")
def heel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return quick_phantom(tmp_path_factory.mktemp("made") / "heel", seed=1)


@pytest.mark.usefixtures("in_this_process")
def test_the_lines_of_the_readme(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    copy_scans(tmp_path)
    monkeypatch.chdir(tmp_path)
    (block,) = Sybil(parsers=[PythonCodeBlockParser()]).parse(ROOT / "README.md").examples()
    block.evaluate()
    assert re.fullmatch(r"(Trust|Use with care|Do not trust) \(\d+, \d+, \d+\)\n", capsys.readouterr().out)
    assert (tmp_path / "max_shear.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("in_this_process")
def test_dvc_in_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy_scans(tmp_path)
    follow("python/dvc.md", tmp_path, monkeypatch)


def test_strokes_that_were_drawn_in_napari_are_saved_on_the_grid_of_the_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a stand-in for napari, in whose place somebody draws a stroke of fat and closes the window."""
    copy_scans(tmp_path)
    monkeypatch.chdir(tmp_path)
    layers: list[np.ndarray] = []

    class Viewer:
        def add_image(self, data: np.ndarray, *, scale: np.ndarray) -> None:
            assert data.ndim == len(scale)

        def add_labels(self, data: np.ndarray, *, scale: np.ndarray) -> SimpleNamespace:
            layers.append(data)
            return SimpleNamespace(data=data)

    def run() -> None:
        layers[0][2:5, 7, 9] = 2

    monkeypatch.setitem(sys.modules, "napari", SimpleNamespace(Viewer=Viewer, run=run))
    blocks = Sybil(parsers=[PythonCodeBlockParser()]).parse(DOCS / "measure.md").examples()
    (block,) = [block for block in blocks if "napari" in block.parsed]
    block.evaluate()
    saved = read_marks(tmp_path / "strokes.nii.gz", None)
    assert saved.names == {2: "fat"}
    assert np.argwhere(saved.labels).tolist() == [[2, 7, 9], [3, 7, 9], [4, 7, 9]]
    assert saved.grid.same_as(read_image(tmp_path / "Load0.nii.gz").grid)


@pytest.mark.usefixtures("in_this_process")
def test_fe_in_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    follow("python/fe.md", tmp_path, monkeypatch)


@pytest.mark.full_size
@pytest.mark.usefixtures("in_this_process")
def test_phantoms_in_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    follow("python/phantoms.md", tmp_path, monkeypatch)


@pytest.mark.full_size
@pytest.mark.usefixtures("in_this_process")
def test_validate_in_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mesh_labels_once: Callable[..., object]
) -> None:
    monkeypatch.setattr(fe, "mesh_labels", mesh_labels_once)  # the gallery has the same
    follow("python/validate.md", tmp_path, monkeypatch)  # which makes all its files itself


def write_spam(folder: Path, gradient: np.ndarray) -> None:
    """An oblique image, and a linear displacement of its voxels as spam-ldic writes it: in voxels, Z first."""
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    grid = Grid((24, 21, 18), (1.0, 1.2, 1.5), (5.0, -7.0, 9.0), turned)
    inside = np.zeros(grid.shape, dtype=np.float32)
    inside[3:-3, 3:-3, 3:-3] = 100.0
    write_image(folder / "Load0.nii.gz", Image(grid, inside))
    zyx = np.stack(np.meshgrid(*(np.arange(2.0, n - 1.0, 3.0) for n in (18, 21, 24)), indexing="ij"), -1).reshape(-1, 3)
    u_mm = grid.points_at(zyx[:, ::-1]) @ gradient.T
    voxels = (u_mm @ turned / grid.spacing_mm)[:, ::-1]
    head = ["NodeNumber", "Zpos", "Ypos", "Xpos", "Zdisp", "Ydisp", "Xdisp", "returnStatus"]
    rows = np.column_stack([np.arange(len(zyx)), zyx, voxels, np.full(len(zyx), 2.0)])
    np.savetxt(folder / "Load0-Load1-ldic.tsv", rows, delimiter="\t", header="\t".join(head), comments="")


def test_coming_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gradient = np.array([[0.05, 0.2, 0.0], [0.0, -0.04, 0.1], [0.0, 0.03, 0.02]])
    write_spam(tmp_path, gradient)
    names = follow("coming-from.md", tmp_path, monkeypatch)
    found = names["measured"].max_shear  # type: ignore[attr-defined]
    true = StrainField.from_gradient(gradient[None]).max_shear[0]
    np.testing.assert_allclose(found[np.isfinite(found)], true, rtol=0.01)
    (block,) = re.findall(r"^```toml\n(.*?)^```", (DOCS / "coming-from.md").read_text(), re.S | re.M)
    (tmp_path / "mine.toml").write_text(block)
    fat = read_material_sets(tmp_path / "mine.toml")["mine"].materials["fat"]
    assert fat.shear_modulus_mpa == pytest.approx(0.0017)


@pytest.mark.full_size
def test_register(heel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(heel, tmp_path / "heel")
    follow("tutorials/register.md", tmp_path, monkeypatch)


@pytest.mark.full_size
def test_validate(heel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(heel, tmp_path / "heel")
    follow("tutorials/validate.md", tmp_path, monkeypatch)


@pytest.mark.full_size
def test_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "quick.txt").write_text(QUICK)
    follow("tutorials/preset.md", tmp_path, monkeypatch)


@pytest.mark.usefixtures("in_this_process")
def test_material(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    follow("tutorials/material.md", tmp_path, monkeypatch)


@pytest.mark.full_size
def test_cohort(heel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in (1, 2):
        subject = tmp_path / f"subject-{seed}"
        if seed == 1:
            shutil.copytree(heel, subject)
        else:
            quick_phantom(subject, seed)
        for name, share in (("near", 0.9), ("far", 1.4)):
            write_model(subject, subject / name, seed, share)
            (subject / name / "model.toml").write_text('mesh = "heel.inp"\nunit = "m"\nframe = "RAS"\n')
    follow("tutorials/cohort.md", tmp_path, monkeypatch)


def commands_told() -> list[tuple[str, str]]:
    """Every `mrstrain ...` line in the code blocks of README and site, with its page."""
    told = []
    for page in PAGES:
        for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.S | re.M):
            told += [(page.name, line) for line in block.replace("\\\n", " ").splitlines()]
        told += [(page.name, line.strip()) for line in page.read_text().splitlines() if line.startswith("    ")]
    return [(page, line.split("#")[0]) for page, line in told if line.startswith("mrstrain ")]


def test_every_command_and_option_of_the_pages_is_there() -> None:
    known = {name: one for name, one in typer.main.get_command(app).commands.items()}  # type: ignore[attr-defined]
    told = commands_told()
    assert len(told) > 10
    for page in PAGES:  # none stands in running text
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
        assert not re.search(r"^mrstrain [a-z]+ .*--", text, re.M), page
    for page, line in told:
        _, name, *words = line.split()
        assert name in known, (page, line)
        options = {option for parameter in known[name].params for option in parameter.opts}
        unknown = {word for word in words if word.startswith("--")} - options
        assert not unknown, (page, line)


def test_study_files_of_the_pages_can_be_read(tmp_path: Path) -> None:
    blocks = [
        block
        for page in PAGES
        for block in re.findall(r"^```toml\n(.*?)^```", page.read_text(), re.S | re.M)
        if "[study]" in block
    ]
    assert blocks
    for number, block in enumerate(blocks):
        (tmp_path / f"{number}.toml").write_text(block)
        assert read_study(tmp_path / f"{number}.toml").loads


def test_the_page_shows_the_quick_parameters_that_the_tests_use() -> None:
    assert f"```text{QUICK}```" in (DOCS / "tutorials" / "register.md").read_text()


def anchors(page: Path) -> set[str]:
    """Of the headings of a page, as the site and the repository's host make them."""
    whole = re.sub(r'^--8<-- "([^":]+)"$', lambda part: (ROOT / part[1]).read_text(), page.read_text(), flags=re.M)
    text = re.sub(r"^```.*?^```", "", whole, flags=re.S | re.M)
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", heading.lower()).strip()) for heading in headings}


def test_every_link_leads_somewhere() -> None:
    links = [
        (page, link)
        for page in [*PAGES, *sorted((ROOT / "benchmarks").glob("*.md"))]
        for link in re.findall(r"\]\(([^)]+)\)", page.read_text())
        if not link.startswith("https://")
    ]
    assert len(links) > 50
    for page, link in links:
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        assert target.exists(), (page, link)
        assert not anchor or anchor in anchors(target), (page, link)


def test_the_site_has_every_page_and_the_reference_every_name() -> None:
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    assert listed == {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    names = [name for page in (DOCS / "api").glob("*.md") for name in re.findall(r"^::: (\S+)", page.read_text(), re.M)]
    assert len(names) > 20
    for name in names:
        pkgutil.resolve_name(name)
    for page in DOCS.rglob("*.md"):
        for included in re.findall(r'--8<-- "([^":]+)', page.read_text()):
            assert (ROOT / included).is_file(), page
