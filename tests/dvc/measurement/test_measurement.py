"""A measurement from arrays, without a file; written and read again; as a notebook and a figure show it."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import dvc
from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.io import result_folder as files
from dvc.measurement.page import key_figures
from dvc.measurement.subject import LabelsFromImage
from dvc.registration.register import Settings
from dvc.report.page import Picture
from dvc.trust.error_model import POOLED, ErrorModel, ErrorTable
from dvc.trust.twin_judgement import Judged
from tests.processes import tasks_run_here
from tests.textures import everything, pair_of

pytestmark = pytest.mark.usefixtures("in_this_process")

GRID = dvc.Grid((14, 16, 18), (1.5, 1.2, 1.0), (-8.0, 3.0, 5.0))
PNG = b"\x89PNG\r\n\x1a\n"
ATTACK = "<script>alert('x')</script>"


@pytest.fixture(scope="module")
def measured(tiny_pair, worker) -> dvc.Measurement:
    """A pressed heel of 2.3 mm: with labels but one smooth spline, for speed, and by weights fixed beforehand."""
    settings = Settings.of("gauss-newton").of_repeat()
    flat = {POOLED: np.full((6, 1, 2), 0.02)}
    lengths = {"correlation_mm": 4.0, "component_correlation_mm": (3.0, 5.0)}
    table = ErrorTable(np.full(3, 2.3), 25.0, np.array([0.0, 0.5]), np.zeros(1), flat, (flat,), **lengths)
    digest = hashlib.sha256(settings.engine.text.encode()).hexdigest()
    with tasks_run_here():
        return dvc.measure(
            tiny_pair.reference,
            tiny_pair.loaded,
            bone=tiny_pair.bone,
            labels=tiny_pair.labels,
            settings=settings,
            error_model=ErrorModel("gauss-newton", digest, (table,), "made up"),
            repeat=tiny_pair.repeat,
            shear_direction=(0.0, -1.0, 0.0),
            name="Load1",
            worker=worker,
        )


def test_labels_made_from_the_image_are_told_and_count_in_the_verdict(measured) -> None:
    def again(made: LabelsFromImage) -> dvc.Measurement:
        subject = replace(measured.source.subject, from_image=made)
        return dvc.Measurement.from_registration(measured.source.registration, subject)

    sure, note = again(LabelsFromImage(0.2)), "No skin was found: too thick voxels."
    before = dvc.Measurement.from_registration(measured.source.registration, measured.source.subject)
    assert sure.verdict == before.verdict
    drawn = dict.fromkeys(sure.drawings(), Picture("", "", PNG))
    told = "The label map was made from the image; 20 % of its voxels have an uncertain label."
    assert told in sure.section(drawn).tables[0].note
    unsure = again(LabelsFromImage(0.21, (note,)))
    assert unsure.verdict.level == "caution"
    assert unsure.verdict.reasons[-2] == f"The label map was made from the image. {note}"
    assert (
        "21 % of its voxels have an uncertain label (limit: 'Use with care' above 20 %)" in unsure.verdict.reasons[-1]
    )


@pytest.fixture(scope="module")
def written(measured, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("measured") / "Load1"
    measured.write(folder, {"command": "test"})
    return folder


@pytest.fixture
def stretched() -> dvc.Measurement:
    """A stretch of a tenth along x, found elsewhere."""
    values = np.zeros(GRID.shape, dtype=np.float32)
    values[3:-3, 3:-3, 3:-3] = 100.0
    tissue = dvc.Mask(GRID, values > 0)
    labels = dvc.LabelMap(GRID, tissue.inside.astype(int), {1: f"fat {ATTACK}"})
    subject = dvc.Subject(dvc.Image(GRID, values), tissue=tissue, labels=labels)
    motion = dvc.Affine(np.diag([1.1, 1.0, 1.0]), np.zeros(3))
    return dvc.Measurement.from_deformation(motion, subject, name=f"{ATTACK}")


def test_arrays_in_and_arrays_out(measured, tiny_pair):
    assert measured.maps.grid.same_as(tiny_pair.reference.grid)
    fat = tiny_pair.labels.region("fat").inside & measured.maps.valid
    truth = dvc.strain_maps(tiny_pair.deformation, dvc.Mask(tiny_pair.reference.grid, fat)).max_shear
    assert np.corrcoef(measured.max_shear[fat], truth[fat])[0, 1] > 0.7
    moved = measured.bone_motion.displacement(tiny_pair.bone.points())
    np.testing.assert_allclose(moved, tiny_pair.foot_motion.displacement(tiny_pair.bone.points()), atol=0.6)
    assert measured.quality.noise_floor.max_shear_p95 > 0.0
    assert measured.sigma is not None
    assert {i.region for i in measured.intervals} >= {"fat", "muscle"}
    assert str(measured).startswith(f"Load1: {measured.verdict.words}.\n")
    fat = {i.statistic: f"{i.found:.3f} ({i.low:.3f} to {i.high:.3f})" for i in measured.intervals if i.region == "fat"}
    line = "maximum shear strain (E1 - E3)/2, median / 95th percentile (95 % interval): "
    assert line in str(measured)
    assert f"fat {fat['median']} / {fat['p95']}" in str(measured)


def test_true_fields_can_be_drawn_also_from_a_folder(measured, written, stretched):
    """The same draws of both, with the spread of the error bars where strain is known, and none without error bars."""
    fields = list(measured.draws(20, seed=5))
    again = next(dvc.Measurement.read(written).draws(1, seed=5))
    for name in ("displacement_mm", "green_lagrange", "max_shear"):
        np.testing.assert_allclose(getattr(again, name), getattr(fields[0], name), rtol=1e-5, atol=1e-6, err_msg=name)
    soft = np.isfinite(measured.bias)  # sigma is unknown in skin without strain discontinuities
    assert (np.isfinite(fields[0].max_shear) == soft).all()
    u = np.array([f.displacement_mm[soft] for f in fields])
    assert u.std() == pytest.approx(np.std(measured.maps.displacement_mm[soft]), rel=0.1)
    assert u.std(axis=0).mean() == pytest.approx(np.nanmean(measured.components.displacement_mm), rel=0.1)
    with pytest.raises(InputError, match="1 or more"):
        measured.draws(0)
    with pytest.raises(InputError, match="no error bars"):
        stretched.draws(1)


def test_what_is_written_is_read_again(measured, written):
    again = dvc.Measurement.read(written)
    for name in ("valid", "displacement_mm", "green_lagrange", "max_shear", "jacobian"):
        np.testing.assert_array_equal(getattr(again.maps, name), getattr(measured.maps, name), err_msg=name)
    assert again.maps.grid.same_as(measured.maps.grid)
    assert (again.name, again.verdict, again.quality.as_dict()) == (
        "Load1",
        measured.verdict,
        measured.quality.as_dict(),
    )
    np.testing.assert_array_equal(again.sigma, measured.sigma)
    np.testing.assert_array_equal(again.bias, measured.bias)
    for name in ("strain_bias", "normal_strain", "shear_strain", "displacement_mm"):
        np.testing.assert_array_equal(getattr(again.components, name), getattr(measured.components, name), err_msg=name)
    for one, other in zip(again.components.rows, measured.components.rows, strict=True):
        assert (one.region, one.component, one.unit) == (other.region, other.component, other.unit)
        numbers = list(asdict(other).values())[3:]
        assert list(asdict(one).values())[3:] == pytest.approx(numbers, rel=1e-5, nan_ok=True)
    for one, other in zip(again.intervals, measured.intervals, strict=True):
        assert (one.region, one.statistic) == (other.region, other.statistic)
        assert list(asdict(one).values())[2:] == pytest.approx(list(asdict(other).values())[2:], rel=1e-5)
    for row, kept in zip(again.regions, measured.regions, strict=True):
        above = row.volume_above_ml, kept.volume_above_ml
        assert dict(above[0]) == pytest.approx(dict(above[1]), rel=1e-8)
        (region, quantity, *numbers, _), (*names, _) = (list(asdict(one).values()) for one in (row, kept))
        assert (region, quantity) == tuple(names[:2])
        assert numbers == pytest.approx(names[2:], rel=1e-8, nan_ok=True)
    assert again.alignment == measured.alignment
    assert str(again) == str(measured)
    X = measured.maps.grid.points(measured.maps.valid)[::50]
    u, H = again.deformation.evaluate(X)
    v, J = measured.deformation.evaluate(X)
    np.testing.assert_allclose(u, v, atol=1e-6)
    np.testing.assert_allclose(H, J, atol=1e-6)
    with pytest.raises(InputError, match="Copy the folder"):
        again.write(written.parent / "copy")


def test_what_a_twin_did_is_read_again(measured, tmp_path):
    rows = (Judged("fat", 0.02, 0.01, 0.9, 0.93, 1.2),)
    bars = replace(measured.error_bars, twin=rows, of_twin="widened by the synthetic warp of this pair: fat 1.2 times.")
    replace(measured, error_bars=bars).write(tmp_path / "Load1")
    again = dvc.Measurement.read(tmp_path / "Load1").error_bars
    assert (again.twin, again.of_twin, again.explanation) == (rows, bars.of_twin, bars.explanation)


def test_a_deformation_from_elsewhere_is_a_measurement_too(stretched, tmp_path):
    np.testing.assert_allclose(np.nanmax(stretched.max_shear), (1.1**2 - 1) / 4, rtol=1e-5)
    assert stretched.verdict.level == "caution"
    assert stretched.intervals == ()
    stretched.write(tmp_path / "stretched")
    again = dvc.Measurement.read(tmp_path / "stretched", stretched.image)
    np.testing.assert_array_equal(again.max_shear, stretched.max_shear)
    assert again.image is stretched.image
    assert not (tmp_path / "stretched" / files.PROVENANCE).exists()
    assert dvc.Measurement.read(tmp_path / "stretched").image is None  # nothing lies there to show maps over
    for one in (again, dvc.Measurement.read(tmp_path / "stretched")):
        assert isinstance(one.plot(point_mm=GRID.points_at(np.array([7.0, 7.0, 9.0]))), Figure)
    with pytest.raises(InputError, match="has no error bars"):
        stretched.plot("sigma")


def test_the_headline_is_of_the_region_with_most_strain(stretched):
    strain = "0.052 median, 0.052 at the 95th percentile"  # (1.1² - 1) / 4 = 0.0525
    assert stretched.headline == f"max. shear in fat {ATTACK} {strain}; {stretched.verdict.words}"
    (shear,) = (row for row in stretched.regions if row.quantity == "max_shear")
    small = replace(shear, region="tendon", median=0.2, volume_ml=0.1 * shear.volume_ml)
    none = replace(shear, region="gap", median=float("nan"))
    assert replace(stretched, regions=(none, small, shear)).headline == stretched.headline
    assert replace(stretched, regions=(none,)).headline.startswith("no maximum shear strain; ")


def test_labels_of_another_grid_are_refused_before_anything_is_registered(tiny_pair):
    labels = replace(tiny_pair.labels, grid=tiny_pair.labels.grid.moved_by(np.eye(3), np.ones(3)))
    settings = Settings(dvc.GaussNewton())  # which does not need them
    with pytest.raises(GeometryError, match="labels are on another grid"):
        dvc.measure(tiny_pair.reference, tiny_pair.loaded, bone=tiny_pair.bone, labels=labels, settings=settings)


def test_landmarks_are_taken_as_they_are_read():
    body = everything()
    images, point = pair_of(dvc.Affine(np.eye(3), np.array([1.3, -0.6, 0.7])), 0.05), body.grid.centre_mm[None]
    settings = Settings(dvc.GaussNewton(5.0, bending=3.0, volume=300.0), align_on="none")
    one = dvc.measure(*images, tissue=body, landmarks=(point, point, ("heel",)), settings=settings)
    assert one.quality.landmark_errors_mm is not None
    assert one.quality.landmark_errors_mm.size == 1


def test_a_repeat_scan_has_what_applies_to_it_alone(tiny_pair, measured):
    """Its weights are fixed and its strain is the error itself: no table of weights, no error bars, no reason why."""
    subject = dvc.Subject(tiny_pair.reference, tiny_pair.bone)
    found, evidence = measured.source.registration, dvc.Evidence(error_model=measured.error_bars.model)
    loaded, repeat = (
        dvc.Measurement.from_registration(found, subject, evidence, name=name, is_repeat=name == "repeat")
        for name in ("Load1", "repeat")
    )
    sections = [one.section(dict.fromkeys(("strain", "curves"), Picture("", "", PNG))) for one in (loaded, repeat)]
    titles = [[table.title for table in section.tables] for section in sections]
    assert set(titles[0]) - set(titles[1]) >= {"Regularisation weights"}
    assert set(titles[1]) == {"Key results", "Percentiles and volumes of the maximum shear strain"}
    (note,) = [table.note for table in sections[1].tables if table.title == "Key results"]
    assert (
        note == "The regularisation weights of a repeat scan are fixed, so that its noise floor is not smoothed away."
    )
    assert "error bars" not in str(repeat).lower()
    assert [("A repeat scan without load" in str(one)) for one in (loaded, repeat)] == [True, False]
    assert repeat.sigma is None
    beneath = [[name for name, _ in one.drawings()["strain"].beneath] for one in (loaded, repeat)]
    assert beneath == [["unloaded", "loaded, registered"], ["unloaded", "repeat, registered"]]
    assert repeat.error_bars.as_dict() == {
        "known": False,
        "reason": "A repeat scan has no error bars: all of its apparent strain is error.",
    }
    assert any("Noise floor" in str(row[0]) for row in sections[1].tables[0].rows)


def test_images_that_were_aligned_as_a_whole_have_no_figures_of_a_bone(stretched):
    moved = {"rotation_deg": 1.0, "bone_shift_lps_mm": [1.0, 0.0, 0.0], "similarity_before": 0.5, "similarity": 0.9}
    moved |= {"repeatability_rms_mm": 0.1, "control_spacing_mm": [4.0, 4.0, 4.0], "engine": "gauss-newton"}
    rows = {on: str(key_figures(stretched.quality, moved | {"on": on}).rows) for on in ("bone", "image")}
    assert "Rotation of the bone" in rows["bone"]
    assert "Rotation of the body" in rows["image"]
    assert "bone" not in rows["image"]
    assert stretched.drawings()["strain"].caption.endswith(
        "Slices through the middle of the tissue. The scale ends at 0.1 (99th percentile of the measured strain, "
        "rounded up; at most 0.5). Larger values have the last colour."
    )


def test_a_notebook_shows_the_verdict_a_picture_and_a_table_all_escaped(stretched):
    page = stretched._repr_html_()
    assert ATTACK not in page
    assert "&lt;script&gt;" in page
    assert stretched.verdict.words in page
    assert "No images were compared" in page
    (picture,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert base64.b64decode(picture).startswith(b"\x89PNG")
    (row,) = re.findall(r"<tr>(?:<td[^>]*>[^<]*</td>)+</tr>", page)
    assert ">0.052<" in row  # (1.1 ^ 2 - 1) / 4


def titles_of(figure: Figure) -> list[str]:
    """Titles of the slices of a sheet."""
    return [text.get_text() for text in figure.texts]


@pytest.mark.parametrize(
    ("quantity", "label"),
    [
        ("max_shear", "maximum shear strain"),
        ("jacobian", "det F"),
        ("displacement_mm", "mm"),
        ("xy", "component xy"),
        ("sigma", "standard uncertainty"),
    ],
)
def test_any_quantity_is_drawn_on_the_planes_asked_for(measured, quantity, label):
    drawn = measured.plot(quantity, ["coronal"])
    assert isinstance(drawn, Figure)
    _, bar = drawn.axes
    assert titles_of(drawn)[0].startswith("Coronal")
    assert label in bar.get_xlabel()
    assert len(measured.plot(quantity).axes) == 4
    assert titles_of(measured.plot(quantity, "axial"))[0].startswith("Axial")


def test_colours_end_where_they_are_told_to_and_else_above_nearly_all(measured):
    def ends(figure: Figure) -> tuple[float, float]:
        return figure.axes[-1].get_xlim()

    assert ends(measured.plot(largest=0.25)) == pytest.approx((0.0, 0.25))
    low, high = ends(measured.plot())
    assert low == 0.0
    assert np.nanpercentile(measured.max_shear, 90) < high < 2 * np.nanmax(measured.max_shear)
    low, high = ends(measured.plot("zz"))
    assert low == -high


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"quantity": "von Mises"}, "Unknown quantity 'von Mises'; choose one of max_shear"),
        ({"planes": ["oblique"]}, "Planes must be from sagittal"),
        ({"planes": []}, "got none"),
        ({"largest": -0.1}, "must be positive"),
    ],
)
def test_what_cannot_be_drawn_is_refused(stretched, given, message):
    with pytest.raises(InputError, match=message):
        stretched.plot(**given)


def test_a_measurement_read_again_shows_the_same_slices(stretched, tmp_path):
    bone = np.zeros(GRID.shape, dtype=bool)
    bone[4:6, 4:6, 4:7] = True
    subject = replace(stretched.source.subject, bone=dvc.Mask(GRID, bone))
    made = dvc.Measurement.from_deformation(dvc.Affine(np.eye(3), np.zeros(3)), subject)
    made.write(tmp_path / "Load1")
    again = dvc.Measurement.read(tmp_path / "Load1", stretched.image)
    titles = [titles_of(one.plot()) for one in (made, again)]
    assert titles[0] == titles[1]
    assert titles_of(replace(again, shown_mm=None).plot()) != titles[0]
    other = dvc.Grid(GRID.shape, GRID.spacing_mm, GRID.origin_mm + 1.0)
    with pytest.raises(GeometryError, match="image is on another grid"):
        dvc.Measurement.read(tmp_path / "Load1", dvc.Image(other, stretched.image.values))
    (tmp_path / "Load2").mkdir()
    (tmp_path / "Load2" / files.QUALITY).write_text("{}")
    with pytest.raises(InputError, match=r"several loads \(Load1, Load2\); read one, such as .*Load1\."):
        dvc.Measurement.read(tmp_path)


def test_an_argument_is_called_as_it_was_given(stretched):
    with pytest.raises(InputError, match=r"plate_normal \(--plate-normal on the command line\) must be three"):
        dvc.measure(stretched.image, stretched.image, plate_normal=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"`tissue` \(--tissue on the command line\)"):
        dvc.tissue_mask(dvc.Image(GRID, np.ones(GRID.shape)))


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _without_verdict(path: Path) -> None:
    told = json.loads(path.read_text())
    del told["verdict"]
    path.write_text(json.dumps(told))


@pytest.mark.parametrize(
    ("name", "harm"),
    [
        *((name, _cut) for name in (files.DISPLACEMENT, files.GREEN_LAGRANGE, files.MAX_SHEAR, files.VALID)),
        *((name, _cut) for name in (files.QUALITY, files.SIGMA, files.BIAS, files.ERROR_MODEL, files.SPLINE)),
        *((name, Path.unlink) for name in (files.DISPLACEMENT, files.JACOBIAN, files.QUALITY, files.REGIONS)),
        *((name, Path.unlink) for name in (files.SIGMA, files.INTERVALS)),
        (files.QUALITY, _without_verdict),
        (files.REGIONS, lambda path: path.write_text("region,quantity\nfat,max_shear\n")),
        (files.INTERVALS, lambda path: path.write_text("region,figure\nfat,median\n")),
    ],
)
def test_a_damaged_folder_is_refused_with_the_file_that_is_wrong(written, tmp_path, name, harm):
    shutil.copytree(written, tmp_path / "Load1")
    harm(tmp_path / "Load1" / name)
    with pytest.raises((InputError, ImageFileError)) as refused:
        dvc.Measurement.read(tmp_path / "Load1")
    assert name in str(refused.value)


def test_maps_of_two_grids_are_refused(written, stretched, tmp_path):
    shutil.copytree(written, tmp_path / "Load1")
    files.write_image(tmp_path / "Load1" / files.JACOBIAN, stretched.image)
    with pytest.raises(ImageFileError, match=r"jacobian\.nii\.gz: on another grid than max_shear"):
        dvc.Measurement.read(tmp_path / "Load1")
