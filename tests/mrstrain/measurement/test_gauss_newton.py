"""Our own engine in the commands: when it is used, what it tells, and how it treats a repeat scan."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.images.image import Image
from dvc.io.images.labels import read_mask
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_mask
from dvc.io.result_folder import spline_in
from dvc.measurement.page import weights_table
from dvc.registration.elastix.presets import load_preset
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces
from dvc.registration.gauss_newton.fit import USUAL_BENDING, USUAL_VOLUME
from dvc.registration.gauss_newton.with_interfaces import USUAL_SKIN
from dvc.registration.register import Settings
from dvc.trust.error_model import error_model_of
from mrstrain.measurement.engines import engine_of
from mrstrain.measurement.register import register as run, register_one
from mrstrain.options.measurement import RegistrationOptions
from phantoms import Heel, scan
from tests.processes import tasks_run_here

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.fixture(scope="module")
def written(made_once, small_pair) -> Path:
    def fill(folder: Path) -> None:
        write_image(folder / "Load0.nii.gz", small_pair.reference)
        write_image(folder / "Load1.nii.gz", small_pair.loaded)
        write_mask(folder / "bone.nii.gz", small_pair.bone)
        with tasks_run_here():
            results = run(
                folder / "Load0.nii.gz", [folder / "Load1.nii.gz"], out=folder / "out", bone=folder / "bone.nii.gz",
                threads=1,
            )  # fmt: skip
        assert not results.failures

    return made_once("by-gauss-newton", fill)


def test_quality_and_provenance_tell_the_engine_and_how_its_weight_was_chosen(written):
    quality = json.loads((written / "out" / "Load1" / "quality.json").read_text())
    told = quality["regularisation"]
    assert told["rule"].startswith("bending chosen by cross-validation")
    assert len(told["tried"]) >= 3
    assert min(t["left_out_over_best"] for t in told["tried"]) == 1.0
    assert 0.05 < told["weights"]["bending"] < 1000.0
    assert "Error model of gauss-newton" in quality["error_of_max_shear"]["source"]
    record = json.loads((written / "out" / "Load1" / "provenance.json").read_text())
    assert record["parameters"]["engine"] == "gauss-newton"
    assert record["parameters"]["gauss_newton"]["volume"] is None
    assert told["weights"]["volume"] == USUAL_VOLUME
    assert "Incompressibility was enforced" in told["change_of_volume"]["rule"]
    assert record["parameters"]["stages"] == []
    assert "gauss-newton" in (written / "out" / "report.html").read_text()


def test_the_report_tells_apart_what_weights_left():
    """Residuals differ by hundredths of a percent: over the best all of them would read 1."""
    table = weights_table(Choice(GaussNewton().weights, "found", ((1.0, 1.00042), (3.0, 1.0)), ((0.9, 1.0003),)))
    assert table.columns[-1] == "residual in the voxels left out, % above the lowest"
    assert [row[-1] for row in table.rows[-3:]] == pytest.approx([0.042, 0.0, 0.03])


@pytest.mark.full_size
def test_another_persons_heel_is_not_trusted(written, small_pair, tmp_path):
    """Bone is found and folds there are none; only their noise tells that the images could be more alike."""
    write_image(tmp_path / "Load1.nii.gz", scan(Heel(5), small_pair.reference.grid, snr=25.0, number=7))
    results = run(
        written / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "out", bone=written / "bone.nii.gz",
        bending=USUAL_BENDING, volume=USUAL_VOLUME, threads=1,
    )  # fmt: skip
    told = json.loads((tmp_path / "out" / "Load1" / "quality.json").read_text())
    assert told["verdict"]["level"] == "distrust"
    assert any("Check that both images show the same subject" in reason for reason in told["verdict"]["reasons"])
    right = json.loads((written / "out" / "Load1" / "quality.json").read_text())
    lacks = right["local_similarity_that_noise_allows"] - right["local_similarity"]["after_all"]
    assert lacks < 0.03
    assert right["verdict"]["level"] == "trust"
    assert not results.failures


@pytest.mark.full_size
def test_a_change_of_volume_that_was_allowed_is_told_and_costs_trust(tiny_pair, tmp_path, monkeypatch):
    """By a limit under which every pair asks for one, in what is made of a result."""
    monkeypatch.setattr("dvc.registration.gauss_newton.choice._ASKED", -1.0)
    monkeypatch.setattr("dvc.registration.gauss_newton.fit._LARGEST", 100.0)  # the pair has voxels of 12 mm3
    for name in ("reference", "loaded"):
        write_image(tmp_path / f"{name}.nii.gz", getattr(tiny_pair, name))
    write_mask(tmp_path / "bone.nii.gz", tiny_pair.bone)
    run(
        tmp_path / "reference.nii.gz", [tmp_path / "loaded.nii.gz"], out=tmp_path / "out", threads=1,
        bone=tmp_path / "bone.nii.gz", bending=USUAL_BENDING,
    )  # fmt: skip
    told = json.loads((tmp_path / "out" / "loaded" / "quality.json").read_text())
    assert told["verdict"]["level"] != "trust"
    assert any("images indicate volume changes" in reason for reason in told["verdict"]["reasons"])
    report = (tmp_path / "out" / "report.html").read_text()
    assert "gradient of the volume change" in report
    assert "Only the gradient of the volume change was penalised" in report


def test_an_offset_of_brightness_is_not_trusted(written, tiny_pair, tmp_path):
    """It is taken for motion, of a kind that changes volume: that is told, too, and lowers the offset that is left."""
    loaded = tiny_pair.loaded
    write_image(tmp_path / "Load0.nii.gz", tiny_pair.reference)
    write_mask(tmp_path / "bone.nii.gz", tiny_pair.bone)
    rising = np.linspace(0.0, 0.3, loaded.grid.shape[1])[:, None] * np.percentile(loaded.values, 90)
    write_image(tmp_path / "Load1.nii.gz", Image(loaded.grid, (loaded.values + rising).astype(np.float32)))
    run(
        tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "out", bone=tmp_path / "bone.nii.gz",
        bending=USUAL_BENDING, threads=1,
    )  # fmt: skip
    told = json.loads((tmp_path / "out" / "Load1" / "quality.json").read_text())
    right = json.loads((written / "out" / "Load1" / "quality.json").read_text())
    name = "offset_between_images_over_brightness"
    assert right[name] < 0.05
    assert told[name] > 0.07
    assert any("differ by an offset in brightness" in reason for reason in told["verdict"]["reasons"])
    assert told["verdict"]["level"] == "distrust"


def test_error_bars_are_the_engines_own(written):
    assert (written / "out" / "Load1" / "sigma_max_shear.nii.gz").exists()
    assert json.loads((written / "out" / "Load1" / "error_model.json").read_text())["preset"] == "gauss-newton-bone"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"engine": "gauss-newton", "preset": "heel-mr"}, "elastix"),
        ({"engine": "elastix", "bending": 3.0}, "gauss-newton"),
        ({"preset": "heel-mr", "parameters": ["mine.txt"]}, "use only one of them"),
        ({"engine": "ants"}, "must be elastix or gauss-newton"),
    ],
)
def test_what_belongs_to_the_other_engine_is_refused_first(written, tmp_path, given, told):
    with pytest.raises(ParameterError, match=told):
        run(
            written / "Load0.nii.gz", [written / "Load1.nii.gz"], out=tmp_path / "o", bone=written / "bone.nii.gz",
            **given,
        )  # fmt: skip
    assert not (tmp_path / "o").exists()


def test_a_repeat_scan_is_smoothed_no_more_than_a_load(written, tmp_path, monkeypatch):
    """Chosen for a pair without strain the weight is the greatest, and the floor would be far below a load's noise."""
    used = {}

    def never(reference, loaded, *, settings, **_):
        used[float(loaded.values[0, 0, 0])] = settings.engine
        raise RegistrationError("enough")

    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", never)
    load0, load1 = read_image(written / "Load0.nii.gz"), read_image(written / "Load1.nii.gz")
    for number, name in ((1.0, "Load1"), (2.0, "again")):
        values = load1.values.copy()
        values[0, 0, 0] = number
        write_image(tmp_path / f"{name}.nii.gz", Image(load1.grid, values))
    write_mask(tmp_path / "labels.nii.gz", read_mask(written / "bone.nii.gz", load0.grid))
    with pytest.raises(RegistrationError):
        run(
            written / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "o", bone=written / "bone.nii.gz",
            repeat=tmp_path / "again.nii.gz", workers=1, threads=1,
        )  # fmt: skip
    fixed = GaussNewton(bending=USUAL_BENDING, volume=USUAL_VOLUME)
    assert used == {1.0: GaussNewtonAtBone(), 2.0: GaussNewtonAtBone(fixed)}
    used.clear()
    with pytest.raises(RegistrationError):
        register_one(
            written / "Load0.nii.gz", tmp_path / "again.nii.gz", out=tmp_path / "repeat",
            labels=tmp_path / "labels.nii.gz", names=None, bone=written / "bone.nii.gz",
        )  # fmt: skip
    assert used == {2.0: GaussNewtonWithInterfaces(fixed, USUAL_SKIN)}
    assert Settings.of("heel-mr").of_repeat() == Settings.of("heel-mr")


def test_a_load_of_a_chain_starts_from_the_result_before_it(written, tmp_path, monkeypatch):
    begun_at = []

    def never(*_, start, **__):
        begun_at.append(start)
        raise RegistrationError("enough")

    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", never)
    before = written / "out" / "Load1"
    for after in (before, None):
        with pytest.raises(RegistrationError, match="enough"):
            register_one(
                written / "Load0.nii.gz", written / "Load1.nii.gz", out=tmp_path / "Load2",
                bone=written / "bone.nii.gz", after=after,
            )  # fmt: skip
    started, anew = begun_at
    np.testing.assert_array_equal(started.jump.coefficients_mm, spline_in(before).jump.coefficients_mm)
    assert anew is None


def test_without_a_rim_the_engine_of_the_record_and_of_the_error_bars_is_the_one_that_was_used(
    tiny_pair, tmp_path, monkeypatch
):
    """One smooth spline, where strain may otherwise be discontinuous at the bone."""
    monkeypatch.setattr("dvc.registration.gauss_newton.with_interfaces._LEAST_SHOWN", 2.0)
    write_image(tmp_path / "Load0.nii.gz", tiny_pair.reference)
    write_image(tmp_path / "Load1.nii.gz", tiny_pair.loaded)
    write_mask(tmp_path / "bone.nii.gz", tiny_pair.bone)
    run(
        tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "out", bone=tmp_path / "bone.nii.gz",
        threads=1,
    )  # fmt: skip
    folder = tmp_path / "out" / "Load1"
    for place in (folder, folder.parent):
        assert json.loads((place / "provenance.json").read_text())["parameters"]["borders"] is None
    assert (folder / "TransformParameters.0.txt").exists()
    told = json.loads((folder / "quality.json").read_text())
    assert "One smooth spline was fitted" in told["regularisation"]["rule"]
    assert "gauss-newton-bone" not in json.dumps(told["error_of_max_shear"])


def test_our_own_engine_is_used_unless_something_of_elastix_is_asked_for(tmp_path):
    (tmp_path / "mine.txt").write_text(load_preset("heel-mr").text)
    asked = RegistrationOptions
    assert engine_of(asked()) == GaussNewtonAtBone()
    assert engine_of(asked(bending=2.0)) == GaussNewtonAtBone(GaussNewton(bending=2.0))
    assert engine_of(asked(borders=False)) == engine_of(asked(align="image")) == GaussNewton()
    assert engine_of(asked(), labelled=True) == GaussNewtonWithInterfaces()
    assert engine_of(asked(borders=False), labelled=True) == GaussNewton()
    assert engine_of(asked(engine="elastix"), labelled=True) == engine_of(asked(engine="elastix"))
    for engine, preset, files, name in (
        (None, "heel-mr", [], "heel-mr"),
        ("elastix", None, [], "heel-mr"),
        (None, None, [tmp_path / "mine.txt"], "mine.txt"),
    ):
        chosen = engine_of(asked(engine=engine, preset=preset, parameters=files))
        assert (chosen.family, chosen.name) == ("elastix", name)


@pytest.mark.full_size
def test_the_twin_of_a_pair_is_measured_again_and_told(tiny_pair, tmp_path):
    write_image(tmp_path / "Load0.nii.gz", tiny_pair.reference)
    write_image(tmp_path / "Load1.nii.gz", tiny_pair.loaded)
    write_mask(tmp_path / "bone.nii.gz", tiny_pair.bone)
    given = {"bone": tmp_path / "bone.nii.gz", "threads": 1, "twin": True}
    given |= {"bending": USUAL_BENDING, "volume": USUAL_VOLUME}
    stages = []
    results = run(
        tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "out", **given,
        progress=lambda case, stage, _: stages.append((case, stage)),
    )  # fmt: skip
    assert not results.failures
    assert ("Load1", "making the synthetic warp") in stages
    quality = json.loads((tmp_path / "out" / "Load1" / "quality.json").read_text())
    (row,) = quality["error_of_max_shear"]["twin"]
    shear = read_image(tmp_path / "out" / "Load1" / "max_shear.nii.gz", allow_missing=True).values
    # much of the shear is found again, and not all: a twin that was not moved, or is the pair itself, would show here
    assert 0.003 < row["rms_error"] < 0.6 * float(np.sqrt(np.nanmean(shear**2)))
    assert any("In the synthetic warp of this pair, the error (rms)" in line for line in results.summary())
    assert "Check by a synthetic warp of this pair" in (tmp_path / "out" / "report.html").read_text()
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert record["parameters"]["twin"] is True


def test_an_error_model_of_another_engine_is_refused_before_anything_runs(written, tmp_path):
    """That of one smooth spline is taken: it is used if no rim shows the surface of the bone."""
    given = written / "Load0.nii.gz", [written / "Load1.nii.gz"]
    error_model_of("gauss-newton-borders").write(tmp_path / "gauss-newton-borders.json")
    with pytest.raises(InputError, match=r"is for gauss-newton-borders, but .* gauss-newton-bone"):
        run(
            *given, out=tmp_path / "o", bone=written / "bone.nii.gz", error_model=tmp_path / "gauss-newton-borders.json"
        )
    assert not (tmp_path / "o" / "Load1").exists()
    assert "gauss-newton" in GaussNewtonAtBone().may_be
