"""A model carried on over an image, and sent through the measurement."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest

from dvc import load_preset
from dvc.deformation.nodal import OnMesh
from dvc.deformation.protocol import evaluate_on_grid
from dvc.errors import InputError, RegistrationError
from dvc.images.image import Grid, Mask
from dvc.io.images.write import write_image, write_mask
from dvc.io.result_folder import write_displacement
from dvc.mesh import TetMesh
from dvc.registration.gauss_newton.fit import USUAL_VOLUME
from mrstrain.comparison.level import level
from mrstrain.options.measurement import RegistrationOptions
from mrstrain.records.provenance import provenance
from phantoms import heel_grid, labels_of, scan
from tests.blocks import block
from tests.quick import QUICK
from tests.validate.test_comparison import case, cube, error_table, labels, sheared
from tests.validate.test_measured_boundary import SHEAR, slab
from validate import ALL, LEVELLED, FeResult, compare_load, extrapolated, read_result


def test_a_model_is_itself_in_its_mesh_at_rest_in_bone_and_smooth_between() -> None:
    grid = Grid((40, 40, 40), np.ones(3), np.full(3, -9.5), np.eye(3))
    mesh = slab()  # from 0 to 20 mm
    x = grid.points().reshape(*grid.shape, 3)
    bone = x[..., 0] < 0.0
    field = extrapolated(OnMesh(mesh, SHEAR.displacement(mesh.points_mm)), grid, bone)
    inside = ((x > 0.0) & (x < 20.0)).all(axis=-1)
    u, H = (v.reshape(*grid.shape, *v.shape[1:]) for v in evaluate_on_grid(field, grid))
    assert np.abs(u - SHEAR.displacement(x.reshape(-1, 3)).reshape(u.shape))[inside].max() < 1e-9
    assert np.abs(u[bone & ~inside]).max() < 1e-9
    assert np.isfinite(u).all()
    assert np.linalg.det(H + np.eye(3)).min() > 0.1
    steps = np.abs(np.diff(u, axis=1)).max()
    assert steps < 2.5  # mm from voxel to voxel, where 6 mm of the model ends
    with pytest.raises(InputError, match="No voxel"):
        extrapolated(
            OnMesh(mesh, np.zeros_like(mesh.points_mm)),
            Grid((5, 5, 5), np.ones(3), np.full(3, 90.0)),
            np.zeros((5, 5, 5), dtype=bool),
        )


def test_a_model_that_is_nearly_flat_is_smoothed_until_an_image_can_show_it() -> None:
    grid = Grid((40, 40, 40), np.ones(3), np.full(3, -9.5), np.eye(3))
    mesh = slab(10)
    u = np.zeros_like(mesh.points_mm)
    u[:, 0] = np.where(mesh.points_mm[:, 0] > 10.5, -1.9, 0.0)  # one layer of 2 mm is pressed to a twentieth
    field = extrapolated(OnMesh(mesh, u), grid, np.zeros(grid.shape, dtype=bool))
    _, H = evaluate_on_grid(field, grid)
    assert np.linalg.det(H + np.eye(3)).min() > 0.0


def test_levelled_models_are_judged_as_found() -> None:
    mesh = cube(6)

    def of(name: str, gamma: float) -> FeResult:
        return FeResult(name, Path(), OnMesh(mesh, sheared(gamma).displacement(mesh.points_mm)))

    results = [of("a", 0.6), of("b", 0.5), of("a" + LEVELLED, 0.8)]
    one = compare_load(case("Load1", sheared(0.8), results, error_table(0.05, 0.01)), labels())
    assert [a.model for a in one.ranked()] == ["a", "b"]
    area = {a.model: a for a in one.areas if a.tissue == ALL}
    assert area["a" + LEVELLED].ml == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(area["a" + LEVELLED].estimate_ml)


@dataclass(frozen=True)
class Bumped:
    """A heel's image and bone in a folder, and a model in it whose fat moves by up to 3 mm."""

    folder: Path
    grid: Grid
    body: np.ndarray
    mesh: TetMesh
    u: np.ndarray


@pytest.fixture
def bumped(tmp_path: Path, heel, request: pytest.FixtureRequest) -> Bumped:
    measured = request.node.get_closest_marker("full_size")  # elsewhere nothing is registered
    grid = heel_grid(1.6 if measured else 2.3)
    tissues = labels_of(heel, grid)
    write_image(tmp_path / "Load0.nii.gz", scan(heel, grid, snr=25.0, number=0))
    bone = next(n for n, name in tissues.names.items() if name == "bone")
    write_mask(tmp_path / "bone.nii.gz", Mask(grid, tissues.labels == bone))
    fat = next(n for n, name in tissues.names.items() if name == "fat")
    centre = np.median(grid.points(tissues.labels == fat), axis=0)
    made = block((10, 10, 10), (30.0, 30.0, 30.0))
    mesh = TetMesh(made.points_mm + centre - 15.0, made.cells, {"fat": np.arange(len(made.cells))})
    bump = np.prod(np.sin(np.pi * made.points_mm / 30.0), axis=1)
    u = bump[:, None] * np.array([0.0, 3.0, 0.0])
    (tmp_path / "model").mkdir()
    meshio.write(
        tmp_path / "model" / "Load1.vtu", meshio.Mesh(mesh.points_mm, [("tetra", mesh.cells)], {"displacement": u})
    )
    body = tissues.labels[tuple(np.rint(grid.indices_of(mesh.points_mm)).astype(int).T)] > 0
    return Bumped(tmp_path, grid, body, mesh, u)


@pytest.mark.full_size
def test_what_comes_back_is_the_model_as_the_measurement_shows_it(bumped: Bumped) -> None:
    folder, body, u = bumped.folder, bumped.body, bumped.u
    (folder / "mine.txt").write_text(
        QUICK.replace("8.0", "5.0").replace("Resolutions 2", "Resolutions 3").replace("80)", "200)")
    )
    # The model moves bone and changes volume, which our own engine would not let it do.
    done = level(
        folder / "Load0.nii.gz", folder / "model", out=folder / "out", bone=folder / "bone.nii.gz",
        parameters=[folder / "mine.txt"],
    )  # fmt: skip
    assert done.out.name == "model" + LEVELLED
    back = read_result("levelled", done.out / "Load1.vtu")
    moved = np.linalg.norm(u, axis=1) > 1.0
    size, apart = (np.linalg.norm(v, axis=1)[body & moved] for v in (u, back.deformation.u_mm - u))
    assert np.median(apart) < 0.5 * np.median(size)  # voxels of 1.6 mm
    assert np.corrcoef(back.deformation.u_mm[body & moved, 1], u[body & moved, 1])[0, 1] > 0.8


def test_levelling_takes_image_bone_and_engine_from_the_measurement(
    bumped: Bumped, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, measured = bumped.folder, bumped.folder / "measured" / "Load1"
    measured.mkdir(parents=True)
    write_displacement(measured, bumped.grid, np.zeros((*bumped.grid.shape, 3), dtype=np.float32))
    given = {"load0": folder / "scan.nii.gz", "bone": folder / "bone.nii.gz"}
    (folder / "Load0.nii.gz").rename(given["load0"])  # no other test has such a file
    stages = [{"name": "heel-mr", "text": load_preset("heel-mr").text}]
    record = provenance("register", given, {"engine": "elastix", "stages": stages})
    (measured / "provenance.json").write_text(json.dumps(record))
    asked, said = [], list[tuple[str, str, float]]()

    def registers(load0: Path, _: object, *, out: Path, **options: object) -> None:
        assert said  # what was taken from the record, before the work begins
        asked.append((load0, options["subject_files"], options["registration"]))
        shutil.copytree(measured, out / "Load1")

    monkeypatch.setattr("mrstrain.comparison.level.register", SimpleNamespace(with_options=registers))
    done = level(measured.parent, folder / "model", out=folder / "out", progress=lambda *told: said.append(told))
    ((kind, line, _),) = said  # told once: the outcome does not repeat it
    assert (kind, line in done.lines) == ("note", False)
    ((load0, files, how),) = asked
    assert (load0, files.bone, how.preset) == (given["load0"], given["bone"], "heel-mr")
    told = json.loads((done.out / "provenance.json").read_text())
    assert {role: told["inputs"][role] for role in given} == record["inputs"]
    assert told["parameters"]["preset"] == "heel-mr"
    assert line.startswith(f"From the record of {measured.parent}: --bone ")
    given["load0"].unlink()
    with pytest.raises(InputError, match=r"unloaded image scan.nii.gz .* in place of the results"):
        level(measured.parent, folder / "model", out=folder / "out")


def test_what_cannot_be_levelled_is_refused(bumped: Bumped, monkeypatch: pytest.MonkeyPatch) -> None:
    tmp_path = bumped.folder
    (tmp_path / "out").mkdir()
    for wrong, message in (
        (tmp_path / "model" / "Load1.vtu", "not a folder"),
        (tmp_path / "out", "file of a measured load|No (load|model)"),
    ):
        with pytest.raises(InputError, match=message):
            level(tmp_path / "Load0.nii.gz", wrong, out=tmp_path / "two", bone=tmp_path / "bone.nii.gz")

    def fails(*_: object, registration: RegistrationOptions, **__: object) -> None:
        # Beyond its mesh the model changes tissue's volume as no tissue does: that is not to be followed.
        assert registration.volume == USUAL_VOLUME
        raise RegistrationError("No load could be registered. Load1: folded")

    with monkeypatch.context() as broken:
        broken.setattr("mrstrain.comparison.level.register", SimpleNamespace(with_options=fails))
        with pytest.raises(RegistrationError, match=r"Load1 could not be registered: .* folded"):
            level(tmp_path / "Load0.nii.gz", tmp_path / "model", out=tmp_path / "two", bone=tmp_path / "bone.nii.gz")
    with pytest.raises(InputError, match="needs the bone"):
        level(tmp_path / "Load0.nii.gz", tmp_path / "model", out=tmp_path / "two")
