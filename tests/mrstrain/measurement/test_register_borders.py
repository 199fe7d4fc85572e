"""`register --borders` from images to files: what it gains, what it writes, what it refuses, what it says of itself."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import Interfaces, InterfaceSpline
from dvc.deformation.protocol import Deformation, RigidMotion, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.io.images.labels import read_mask
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_labels, write_mask
from dvc.io.result_folder import SPLINE_WITH_BORDERS, result_folders, spline_in
from dvc.io.transforms.read import read_transform
from dvc.registration.engine import AlignedPair
from dvc.registration.engines import engine_named, methods_of
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces
from dvc.registration.gauss_newton.fit import control_grid
from dvc.registration.gauss_newton.with_interfaces import USUAL_SKIN
from dvc.registration.register import Settings, register
from dvc.worker import Worker
from mrstrain.measurement.engines import engine_of
from mrstrain.measurement.register import register as run, register_one
from mrstrain.measurement.strain import read_any, strain
from mrstrain.options.measurement import RegistrationOptions
from phantoms import Heel, distances_mm, labels_of, random_foot_motion, scan, sliding
from tests.dvc.deformation.test_interface_spline import scanned, sheared
from tests.processes import tasks_run_here

GRID = Grid((35, 35, 28), (1.6, 1.6, 1.6), (-28.2, -10.2, -43.6))  # the pad, with the lower half of the calcaneus
INNER = (slice(3, -3),) * 3


@dataclass(frozen=True)
class Pad:
    """A heel pad whose fat slides along skin and bone at rest: the images in a folder, tissues and truth."""

    folder: Path
    labels: LabelMap
    motion: Deformation

    def apart_mm(self) -> np.ndarray:
        """Distance to the nearest border of tissues."""
        return distances_mm(self.labels)[1]

    def shear_error(self, shear: np.ndarray) -> dict[str, float]:
        """Root mean square error of a map of maximum shear strain: in skin, and in fat within 3 mm of bone."""
        inner = np.zeros(GRID.shape, dtype=bool)
        inner[INNER] = True
        _, H = evaluate_on_grid(self.motion, GRID, inner)
        error = np.full(GRID.shape, np.nan)
        error[inner] = shear[inner] - StrainField.from_gradient(H).max_shear
        fat = self.labels.region("fat").inside & (distances_mm(self.labels)[0] < 3.0)
        parts = {"skin": self.labels.region("skin").inside, "fat": fat}
        return {name: float(np.sqrt(np.nanmean(error[inner & part] ** 2))) for name, part in parts.items()}


@pytest.fixture(scope="module")
def pad(tmp_path_factory) -> Pad:
    folder = tmp_path_factory.mktemp("pad")
    heel = Heel(1)
    motion, foot, labels = sliding(heel, 4.0), random_foot_motion(1, 5), labels_of(heel, GRID)
    for number, (name, how) in enumerate({"Load0": (None, None), "Load1": (motion, foot)}.items()):
        write_image(folder / f"{name}.nii.gz", scan(heel, GRID, *how, snr=25.0, number=number))
    write_labels(folder / "tissues.nrrd", labels)
    return Pad(folder, labels, motion)


def asked(pad: Pad, **more: object) -> dict[str, object]:
    return {"labels": pad.folder / "tissues.nrrd", "names": pad.folder / "tissues.csv", "bone_label": "bone", **more}


@pytest.fixture(scope="module")
def out(pad) -> Path:
    """The load registered with a label map, and so with borders."""
    with tasks_run_here():
        results = run(
            pad.folder / "Load0.nii.gz", [pad.folder / "Load1.nii.gz"], out=pad.folder / "out", threads=1, **asked(pad)
        )
    assert not results.failures
    return results.out


def shear_of(folder: Path) -> np.ndarray:
    return read_image(folder / "max_shear.nii.gz", allow_missing=True).values


ONE_SPLINE = {"skin": 0.126, "fat": 0.108}  # the error of the load registered so, the latter within 3 mm of bone


@pytest.mark.full_size
def test_one_spline_has_the_error_that_others_are_compared_with(pad):
    images, out = (pad.folder / "Load0.nii.gz", [pad.folder / "Load1.nii.gz"]), pad.folder / "smooth"
    with tasks_run_here():
        run(*images, out=out, borders=False, threads=1, **asked(pad))
    assert pad.shear_error(shear_of(out / "Load1")) == pytest.approx(ONE_SPLINE, rel=0.05)


def test_strain_is_found_up_to_bone_and_skin(pad, out):
    """With borders .015 in skin and .037 in fat near bone."""
    error = pad.shear_error(shear_of(out / "Load1"))
    assert error["fat"] < 0.6 * ONE_SPLINE["fat"]
    assert error["skin"] < 0.3 * ONE_SPLINE["skin"]
    assert np.nanmax(shear_of(out / "Load1")[pad.labels.region("bone").inside]) == 0.0


def test_the_bone_mask_alone_lets_strain_jump_at_the_bone(pad, out, tmp_path):
    """With a mask that is a voxel too large .068 in fat near it; an interface where it ends .122."""
    bone, images = pad.labels.region("bone"), (pad.folder / "Load0.nii.gz", [pad.folder / "Load1.nii.gz"])
    write_mask(mask := tmp_path / "bone.nii.gz", Mask(GRID, binary_dilation(bone.inside)))
    with tasks_run_here():
        assert not run(*images, out=tmp_path / "out", bone=mask, threads=1).failures
    folder = tmp_path / "out" / "Load1"
    error = pad.shear_error(shear_of(folder))
    assert error["fat"] < 0.75 * ONE_SPLINE["fat"]
    assert error["skin"] < 1.1 * ONE_SPLINE["skin"]
    assert isinstance(spline_in(folder), InterfaceSpline)
    told = json.loads((folder / "quality.json").read_text())
    assert told["regularisation"]["rigidity_of"] is None  # the bone cannot be strained
    used, given = read_mask(folder / "bone_used.nii.gz").inside, read_mask(mask).inside
    assert np.nanmax(shear_of(folder)[used]) == 0.0
    assert np.count_nonzero(used ^ bone.inside) < 0.5 * np.count_nonzero(given ^ bone.inside)
    assert -1.6 < told["alignment"]["bone_surface_moved_mm"][0] < -0.8
    assert "Distance of the bone surface used" in (tmp_path / "out" / "report.html").read_text()
    assert (folder / "figures" / "bone_used.pdf").is_file()
    assert not list(out.rglob("bone_used*"))
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())["parameters"]
    assert record["borders"] == {"bone_alone": True}
    assert "vanishes on the surface of the bone" in methods_of(record, {})
    assert "vanishes" not in methods_of(record | {"borders": None}, {})


@pytest.mark.full_size
def test_its_transform_is_the_whole_motion_to_itk_and_to_us(pad, out, tmp_path):
    folder = out / "Load1"
    assert not list(folder.glob("TransformParameters*"))
    alignment = json.loads((folder / "quality.json").read_text())["alignment"]
    motion = RigidMotion(np.array(alignment["rotation"]), np.array(alignment["translation_lps_mm"]))
    u = np.asarray(nibabel.load(folder / "displacement.nii.gz").dataobj)[:, :, :, 0]
    known = np.isfinite(u).all(axis=-1)
    X, x = GRID.points(known)[::37], motion.apply(GRID.points(known) + u[known])[::37]
    itk = sitk.ReadTransform(str(folder / "transform.h5"))
    np.testing.assert_allclose([itk.TransformPoint(p) for p in X.tolist()], x, atol=1e-3)
    np.testing.assert_allclose(X + read_transform(folder / "transform.h5").displacement(X), x, atol=1e-3)
    assert np.linalg.norm(u[known], axis=-1).max() > 2.0
    body = tmp_path / "body.nrrd"
    write_labels(body, LabelMap(GRID, (pad.labels.labels > 0).astype(np.int64), {1: "body"}))
    strain(
        pad.folder / "Load0.nii.gz", folder / "transform.h5", out=tmp_path / "again", tissue=body, **asked(pad)
    )  # fmt: skip
    again, first = shear_of(tmp_path / "again" / "transform"), shear_of(folder)
    apart = np.full(GRID.shape, np.nan)
    apart[INNER] = np.abs(again - first)[INNER]
    deep = (pad.apart_mm() > 4.0) & np.isfinite(apart)
    assert np.count_nonzero(deep) > 2000
    assert apart[deep].max() < 0.015
    assert np.nanmax(apart) > 0.1  # a jump between two voxels is lost in displacements at voxels


def test_quality_and_report_tell_the_weights_and_error_bars_are_its_own(out):
    told = json.loads((out / "Load1" / "quality.json").read_text())
    weights = told["regularisation"]
    assert (weights["borders"], weights["rigidity_of"]) == (True, "skin")
    assert min(tried["left_out_over_best"] for tried in weights["tried_in_skin"]) == 1.0
    assert len(weights["tried_in_skin"]) >= 3
    assert weights["weights"]["rigidity"] > 10.0
    assert told["error_of_max_shear"]["known"] is True
    assert "Error model of gauss-newton-borders" in told["error_of_max_shear"]["source"]
    assert "fat,p95," in (out / "Load1" / "intervals.csv").read_text()
    report = (out / "report.html").read_text()
    for sentence in ("Error model of gauss-newton-borders", "No elastix text files are written", "strain of skin"):
        assert sentence in report, sentence
    given = json.loads((out / "Load1" / "provenance.json").read_text())["parameters"]
    assert given["borders"] == {"skin": None}


def test_the_bone_that_is_held_is_judged_by_what_the_images_would_have_it_do(out):
    told = json.loads((out / "Load1" / "quality.json").read_text())
    assert 0.001 < told["bone_shift_rms_mm"] < 0.3
    assert 0.001 < told["bone_shear_p95"] < 0.1
    assert told["bone_figures_before_it_was_held_at_rest"] is True
    assert "in the bone without the rigid constraint" in (out / "report.html").read_text()
    assert np.nanmax(np.abs(nibabel.load(out / "Load1" / "displacement.nii.gz").dataobj)) > 2.0


def test_what_is_read_again_has_the_jumps_that_the_maps_have(pad, out):
    """Displacements at voxels, differentiated, miss the shear by over .1 somewhere (above)."""
    (measured,) = result_folders(out)
    valid = read_mask(out / "Load1" / "valid.nii.gz").inside
    X = GRID.points().reshape(-1, 3)
    u, H = measured.deformation().evaluate(X)
    shear = StrainField.from_gradient(H).max_shear.reshape(GRID.shape)
    np.testing.assert_allclose(shear[valid], shear_of(out / "Load1")[valid], atol=1e-5)
    assert np.isnan(shear[~valid]).all()
    assert np.isnan(u.reshape(*GRID.shape, 3)[~valid]).all()
    spline = read_any(out / "Load1" / SPLINE_WITH_BORDERS)
    assert isinstance(spline, InterfaceSpline)
    assert spline.borders.rest >= 0
    assert [file.name for file in measured.files] == [SPLINE_WITH_BORDERS, "valid.nii.gz"]


def test_a_damaged_spline_is_refused_by_name(out, tmp_path, monkeypatch):
    whole = (out / "Load1" / SPLINE_WITH_BORDERS).read_bytes()
    place = tmp_path / SPLINE_WITH_BORDERS
    for damaged in (whole[: len(whole) // 2], b"", b"PK"):
        place.write_bytes(damaged)
        with pytest.raises(InputError, match=SPLINE_WITH_BORDERS):
            read_transform(place)
    place.write_bytes(whole)
    monkeypatch.setattr("dvc.io.transforms.interface_spline.NUMBERS", {"blur": 2.0})
    with pytest.raises(InputError, match="register again"):  # its depths would be others today
        read_transform(place)
    with pytest.raises(InputError, match="Register this load again"):
        spline_in(tmp_path / "nothing")


def test_a_study_begins_a_load_where_the_one_before_ended(pad, out, monkeypatch):
    used = {}

    def never(*_: object, **given: object) -> None:
        used.update(given)
        raise RegistrationError("enough")

    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", never)
    more = {"labels": pad.folder / "tissues.nrrd", "names": pad.folder / "tissues.csv", "bone_label": "bone"}
    with pytest.raises(RegistrationError, match="enough"):
        register_one(
            pad.folder / "Load0.nii.gz", pad.folder / "Load1.nii.gz", out=pad.folder / "one", after=out / "Load1",
            borders=True, **more,
        )  # fmt: skip
    assert used["settings"].engine == GaussNewtonWithInterfaces()
    np.testing.assert_array_equal(used["labels"].labels, pad.labels.labels)
    u = np.asarray(nibabel.load(out / "Load1" / "displacement.nii.gz").dataobj)[:, :, :, 0]
    known = np.isfinite(u).all(axis=-1)
    assert isinstance(used["start"], InterfaceSpline)
    np.testing.assert_allclose(used["start"].displacement(GRID.points(known)), u[known], atol=1e-5)
    assert np.abs(u[known]).max() > 2.0


FIXED = GaussNewton(bending=3.0, volume=300.0)


@pytest.fixture(scope="module")
def layers() -> dict[str, object]:
    """Fat between bone at rest and stiff skin, small; registered as it lies."""
    fixed, moving, body, labels = scanned(skin=0.0)
    return {
        "reference": fixed, "loaded": moving, "tissue": body, "labels": labels, "bone": labels.region("bone"),
        "settings": Settings(GaussNewtonWithInterfaces(FIXED, 30.0), align_on="none"),
    }  # fmt: skip


@pytest.fixture(scope="module")
def found(layers, worker) -> InterfaceSpline:
    spline = register(**layers, worker=worker).displacement
    assert isinstance(spline, InterfaceSpline)
    return spline


def test_the_images_may_lie_askew_and_be_stored_in_any_order(layers, found, worker):
    """The same scans in a turned world, axes in another order: labels go with them."""
    turn = Rotation.from_rotvec([25.0, -15.0, 35.0], degrees=True).as_matrix()

    def stored(scan: Image | Mask | LabelMap, name: str) -> Image | Mask | LabelMap:
        """Axes k, i, j, the first of them from its far end."""
        values, grid = getattr(scan, name), scan.grid.moved_by(turn, np.zeros(3))
        values = values.transpose(2, 0, 1)[::-1]
        order = [2, 0, 1]
        direction = grid.direction[:, order] * np.array([-1.0, 1.0, 1.0])
        origin = grid.points_at(np.array([0.0, 0.0, grid.shape[2] - 1.0]))
        return replace(scan, grid=Grid(values.shape, grid.spacing_mm[order], origin, direction), **{name: values})

    given = {"reference": "values", "loaded": "values", "tissue": "inside", "bone": "inside", "labels": "labels"}
    askew = register(
        **{name: stored(layers[name], field) for name, field in given.items()}, settings=layers["settings"],
        worker=worker,
    ).displacement  # fmt: skip
    X = layers["reference"].grid.points()[4:-4:3, 4:-4:3, 4:-4:3].reshape(-1, 3)
    u, H = found.evaluate(X)
    other_u, other_H = askew.evaluate(X @ turn.T)
    np.testing.assert_allclose(other_u, u @ turn.T, atol=1e-3)
    np.testing.assert_allclose(turn.T @ other_H @ turn, H, atol=1e-3)


@pytest.mark.parametrize("skin", [USUAL_SKIN, pytest.param(None, marks=pytest.mark.full_size)])
def test_threads_do_not_change_a_bit(layers, skin):
    """From images as they are: N4 and elastix, which come before, do not promise that."""
    fixed, moving, body, labels, bone = (layers[name] for name in ("reference", "loaded", "tissue", "labels", "bone"))
    pair = AlignedPair.of(fixed, moving, RigidMotion.identity(), body, bone, labels)
    engine, told = GaussNewtonWithInterfaces(GaussNewton(bending=3.0), skin), []
    for threads in (1, 2):
        with Worker(threads) as worker:
            told.append(engine.find(pair, start=None, seeds=(), worker=worker, progress=lambda *_: None))
    (one, choice), (two, same) = ((found.displacement, found.choice) for found in told)
    assert choice == same
    assert skin is not None or len(choice.tried_in_skin) >= 3
    np.testing.assert_array_equal(one.smooth.coefficients_mm, two.smooth.coefficients_mm)
    np.testing.assert_array_equal(one.jump.coefficients_mm, two.jump.coefficients_mm)
    np.testing.assert_array_equal(one.borders.depth, two.borders.depth)


def test_labels_of_the_bone_alone_hold_nothing_but_the_bone(layers, worker):
    """Tissue without a label is none that is at rest, though no label is nearer than the bone's."""
    fixed, moving, body, bone = (layers[name] for name in ("reference", "loaded", "tissue", "bone"))
    alone = LabelMap(fixed.grid, bone.inside.astype(np.int64), {1: "bone"})
    pair = AlignedPair.of(fixed, moving, RigidMotion.identity(), body, bone, alone)
    engine = GaussNewtonWithInterfaces(FIXED)
    found = engine.find(pair, start=None, seeds=(), worker=worker, progress=lambda *_: None).displacement
    fat = layers["labels"].region("fat").points()
    true = sheared(fat, 0.0)
    u = found.displacement(fat)
    assert np.median(np.linalg.norm(u - true, axis=1)) < 0.15 * np.median(np.linalg.norm(true, axis=1))
    assert not found.displacement(bone.points()).any()


def test_where_no_rim_shows_the_surface_of_the_bone_one_smooth_spline_is_fitted(layers, worker, caplog):
    """These images have none; at a surface a voxel off, a discontinuity is worse than none."""
    fixed, moving, body, bone = (layers[name] for name in ("reference", "loaded", "tissue", "bone"))
    pair = AlignedPair.of(fixed, moving, RigidMotion.identity(), body, bone, None)
    at_bone, smooth = (
        engine.find(pair, start=None, seeds=(), worker=worker, progress=lambda *_: None)
        for engine in (GaussNewtonAtBone(FIXED), FIXED)
    )
    np.testing.assert_array_equal(at_bone.displacement.coefficients_mm, smooth.displacement.coefficients_mm)
    assert (at_bone.engine, smooth.engine) == (FIXED, None)
    assert "One smooth spline was fitted" in at_bone.choice.rule
    assert "dark rim" in caplog.text


@pytest.mark.full_size
def test_a_result_with_borders_may_be_a_start(layers, worker):
    """Images of one texture, 19 mm apart, which no search from nothing finds; no bone is held."""
    far = np.array([14.0, -10.0, 9.0])
    loaded, labels = layers["loaded"], layers["labels"]
    control = control_grid(labels.grid, np.full(3, 4.0))
    there = np.broadcast_to(far[:, None, None, None], (3, *control.shape))
    start = InterfaceSpline(
        BSpline(control, there), BSpline(control, np.zeros_like(there)), Interfaces.of(labels, None, 3.0)
    )
    moved = replace(loaded, grid=loaded.grid.moved_by(np.eye(3), far))
    X = labels.grid.points()[8:-8:3, 8:-8:3, 8:-8:3].reshape(-1, 3)

    def off_mm(begun_at: InterfaceSpline | None) -> float:
        found = register(**{**layers, "bone": None, "loaded": moved}, start=begun_at, worker=worker).displacement
        return float(np.median(np.linalg.norm(found.displacement(X) - far - sheared(X, 0.0), axis=1)))

    assert off_mm(start) < 0.5
    assert off_mm(None) > 3.0


def test_what_cannot_be_done_is_refused(layers, found, tmp_path, pad):
    missing = {**layers, "labels": None}
    with pytest.raises(InputError, match=r"need a label map: labels \(--labels\)"):
        register(**missing)
    labels = layers["labels"]
    aside = labels.grid.moved_by(np.eye(3), np.array([50.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="not on the grid of the unloaded image"):
        register(**{**layers, "labels": replace(labels, grid=aside)})
    with pytest.raises(InputError, match="label map is empty"):
        register(**{**layers, "labels": replace(labels, labels=np.zeros_like(labels.labels))})
    with pytest.raises(InputError, match="one B-spline; got InterfaceSpline"):
        register(**{**layers, "settings": Settings.of("heel-mr"), "start": found})
    with pytest.raises(ParameterError, match="must be above 0"):
        GaussNewtonWithInterfaces(skin=0.0)
    with pytest.raises(ParameterError, match="borders is only for the engine gauss-newton"):
        engine_of(RegistrationOptions(preset="heel-mr", borders=True))
    with pytest.raises(InputError, match=r"needs images aligned on the bone: align bone \(--align bone\)"):
        register(**{**layers, "settings": Settings(GaussNewtonAtBone(), align_on="image")})
    for wrong, kind, said in (
        ({"align": "image"}, InputError, "needs a label map"),
        (asked(pad, preset="heel-mr"), ParameterError, "borders is only for"),
    ):
        with pytest.raises(kind, match=said):
            run(pad.folder / "Load0.nii.gz", [pad.folder / "Load1.nii.gz"], out=tmp_path / "o", borders=True, **wrong)
    assert not (tmp_path / "o").exists()


def test_its_parameters_are_not_those_of_the_plain_engine():
    plain, with_interfaces = GaussNewton(), GaussNewtonWithInterfaces()
    assert engine_named("gauss-newton-borders") == with_interfaces
    assert (with_interfaces.name, with_interfaces.family) == ("gauss-newton-borders", plain.family)
    told = json.loads(with_interfaces.text)
    assert told.pop("borders")["skin"] is None
    assert told == json.loads(plain.text)
    assert json.loads(with_interfaces.of_repeat().text)["borders"]["skin"] == USUAL_SKIN
    fixed = GaussNewtonWithInterfaces(GaussNewton(bending=2.0, volume=100.0))
    assert fixed.of_repeat() == replace(fixed, skin=USUAL_SKIN)
    assert replace(with_interfaces, skin=7.0).of_repeat().skin == 7.0
