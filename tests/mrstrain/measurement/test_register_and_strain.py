"""`register` and `strain` as a person runs them: every file that is promised, and what must be refused."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import meshio
import nibabel
import numpy as np
import pytest
import SimpleITK as sitk

from dvc.deformation.protocol import RigidMotion
from dvc.deformation.strain import StrainField
from dvc.errors import InputError, OutputError
from dvc.images.image import Image
from dvc.images.resample import carry
from dvc.images.similarity import local_correlation
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_labels, write_mask
from dvc.io.meshes.write import VERDICT_FIELD
from dvc.io.result_folder import result_folders
from dvc.io.transforms.read import read_transform
from dvc.threads import usable_cores
from dvc.trust.error_model import POOLED, ErrorModel, ErrorTable
from mrstrain.comparison.from_record import fill_engine, fill_labels, fill_subject
from mrstrain.measurement.register import register
from mrstrain.measurement.strain import strain
from mrstrain.options.measurement import EngineOptions, SubjectFiles
from mrstrain.options.modelling import ComparisonLabels
from mrstrain.records.measured_with import MeasuredWith
from tests.processes import tasks_run_in
from tests.quick import QUICK

PATIENT = "Doe^Jane"


@pytest.fixture(scope="module")
def study(made_once, tiny_pair) -> Path:
    return made_once("by-command", lambda folder: _fill(folder, tiny_pair))


def _fill(folder: Path, tiny_pair) -> None:
    for name, image in (("Load0", tiny_pair.reference), ("Load1", tiny_pair.loaded), ("again", tiny_pair.repeat)):
        write_image(folder / f"{name}.nii.gz", image)
    written = nibabel.load(folder / "Load1.nii.gz")
    written.header["descrip"] = PATIENT.encode()  # a name in a header must not reach any output
    nibabel.save(written, folder / "Load1.nii.gz")
    write_mask(folder / "bone.nii.gz", tiny_pair.bone)
    write_labels(folder / "tissues.nrrd", tiny_pair.labels)
    (folder / "quick.txt").write_text(QUICK)
    rows = {"fat": [[0.01, 0.02]], POOLED: [[0.02, 0.03]]}
    cells = {tissue: np.array([row, row]) for tissue, row in rows.items()}
    table = ErrorTable(np.full(3, 1.6), 25.0, np.array([0.0, 0.2]), np.zeros(1), cells, (cells,), 8.0)
    digest = hashlib.sha256(QUICK.encode()).hexdigest()
    ErrorModel("quick.txt", digest, (table,), "made up").write(folder / "errors.json")
    points = tiny_pair.labels.region("fat").points()[::1500]
    x = tiny_pair.foot_motion.apply(points + tiny_pair.deformation.displacement(points))
    with (folder / "points.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["x0", "y0", "z0", "x1", "y1", "z1"])
        rows.writerows(np.hstack([points, x]).tolist())
    nodes = tiny_pair.bone.points().mean(axis=0) + np.array([[0, 0, -18], [5, 0, -18], [0, 5, -18], [0, 0, -14.0]])
    meshio.write(folder / "mesh.vtu", meshio.Mesh(nodes, [("tetra", [[0, 2, 1, 3]])]))


@pytest.fixture(scope="module")
def results(study, worker, computed_once):
    given = {
        "out": study / "out", "bone": study / "bone.nii.gz", "labels": study / "tissues.nrrd",
        "names": study / "tissues.csv", "parameters": [study / "quick.txt"], "repeat": study / "again.nii.gz",
        "landmarks": study / "points.csv", "mesh": study / "mesh.vtu", "error_model": study / "errors.json",
        "shear_direction": (0.0, -1.0, 0.0), "workers": 1, "threads": 1, "seed": 5,
    }  # fmt: skip
    with tasks_run_in(worker):
        return computed_once("results", lambda: register(study / "Load0.nii.gz", [study / "Load1.nii.gz"], **given))


PROMISED = [
    "displacement.nii.gz", "displacement.json", "displacement.nrrd", "green_lagrange.nii.gz",
    "green_lagrange_plate.nii.gz",
    "max_shear.nii.gz", "jacobian.nii.gz", "valid.nii.gz", "aligned.nii.gz", "registered.nii.gz",
    "TransformParameters.0.txt", "TransformParameters.1.txt", "transform.h5", "regions.csv", "quality.json",
    "provenance.json", "figures/strain.png", "figures/overlay.png", "figures/checkerboard.png",
    "figures/deformed_grid.png", "mesh.vtu", "nodal_displacements.csv", "sigma_max_shear.nii.gz", "intervals.csv",
    "bias_max_shear.nii.gz",
    "figures/sigma.png", "figures/sigma.pdf", "figures/strain.pdf", "figures/curves.pdf", "figures/curves.csv",
]  # fmt: skip


@pytest.mark.parametrize("name", PROMISED)
def test_every_promised_file_is_there(results, study, name):
    assert not results.failures
    assert (study / "out" / "Load1" / name).stat().st_size > 0


def test_the_report_says_which_images_it_is_about(results, study, tiny_pair):
    page = (study / "out" / "report.html").read_text()
    voxels = str(tiny_pair.reference.grid).partition("; ")[0]
    assert re.fullmatch(r"[\d x]+ voxels of [\d. x]+ mm", voxels)
    assert re.search(rf"<p>Images: [^<]*Load0[^<]*, [^<]*Load1[^<]*\. Maps of {voxels}\.</p>", page)


def test_the_report_begins_with_the_strain_of_the_loads_in_a_picture(results, study):
    first, *others = (study / "out" / "report.html").read_text().split('<details id="part-')[1:]
    assert "<h2>Measured strain</h2>" in first
    figure, table = first.index("<figure>"), first.index("<table>")
    assert figure < table  # the picture comes first, and is that of Load1 without the repeat scan
    assert "<td>fat</td>" in first
    assert "<th scope=row>Load1</th>" in first
    assert "repeat" not in first
    assert not any(part.split(">", 1)[0].endswith("open") for part in others)
    for ending in ("png", "pdf"):
        assert (study / "out" / f"slices_by_load.{ending}").stat().st_size > 0


def test_error_bars_are_those_of_the_model(results, study, tiny_pair):
    folder = study / "out" / "Load1"
    shear = read_image(folder / "max_shear.nii.gz", allow_missing=True).values
    bias, sigma = (read_image(folder / f"{of}_max_shear.nii.gz", allow_missing=True).values for of in ("bias", "sigma"))
    for tissue, low, high in (("fat", 0.01, 0.02), ("muscle", 0.02, 0.03)):
        inside = tiny_pair.labels.region(tissue).inside & np.isfinite(shear)
        for found in (bias, sigma):  # made up to be equal
            np.testing.assert_allclose(found[inside], np.interp(shear[inside], [0.0, 0.2], [low, high]), atol=1e-6)
    assert np.isnan(sigma[tiny_pair.bone.inside]).all()
    with (folder / "intervals.csv").open() as file:
        rows = {(r["region"], r["statistic"]): r for r in csv.DictReader(file)}
    fat = rows["fat", "median"]
    assert float(fat["low"]) < float(fat["estimate"]) < float(fat["high"])
    # the bias of 0.01 to 0.02 is taken out
    assert 0.008 < float(fat["found"]) - float(fat["estimate"]) < 0.022
    assert ("bone", "median") not in rows
    told = json.loads((folder / "quality.json").read_text())["error_of_max_shear"]
    assert told["known"] is True
    assert "made up" in (study / "out" / "report.html").read_text()


def test_its_record_tells_later_commands_what_it_was_made_with(results, study):
    (load,) = result_folders(study / "out")
    record = MeasuredWith.shared([load], "")
    assert record.file("load0") == study / "Load0.nii.gz"
    files = {"bone": study / "bone.nii.gz", "labels": study / "tissues.nrrd", "names": study / "tissues.csv"}
    assert fill_subject(SubjectFiles(), record) == SubjectFiles(**files)
    assert fill_engine(EngineOptions(), record, labelled=False) == EngineOptions(parameters=(study / "quick.txt",))
    assert fill_labels(ComparisonLabels(), [load]) == ComparisonLabels(labels=files["labels"], names=files["names"])
    directions = {"plate_normal_lps": [0.0, 0.0, -1.0], "shear_direction_lps": [0.0, -1.0, 0.0]}
    assert record.parameters.items() >= directions.items()


def test_nothing_half_written_is_left(results, study):
    left = [p.name for p in (study / "out").rglob("*") if p.name.startswith(".")]
    assert left == []


def test_the_displacement_says_its_frame_and_its_twin_says_the_same(results, study):
    folder = study / "out" / "Load1"
    told = json.loads((folder / "displacement.json").read_text())
    assert (told["frame"], told["unit"], told["components"]) == ("LPS", "mm", ["x", "y", "z"])
    nifti = nibabel.load(folder / "displacement.nii.gz")
    assert int(nifti.header["intent_code"]) == 1007
    twin = sitk.GetArrayFromImage(sitk.ReadImage(str(folder / "displacement.nrrd")))
    np.testing.assert_array_equal(np.asarray(nifti.dataobj)[:, :, :, 0], twin.transpose(2, 1, 0, 3))


def test_the_written_transforms_are_the_whole_motion(results, study, tiny_pair):
    folder = study / "out" / "Load1"
    X = tiny_pair.bone.points()[::200]
    chain = X + read_transform(folder / "TransformParameters.1.txt").displacement(X)
    itk = sitk.ReadTransform(str(folder / "transform.h5"))
    np.testing.assert_allclose(chain, [itk.TransformPoint(p.tolist()) for p in X], atol=1e-5)
    shift = np.median(np.linalg.norm(chain - tiny_pair.foot_motion.apply(X), axis=1))
    assert shift < 0.5


def test_the_measured_displacement_is_relative_to_the_bone(results, study, tiny_pair):
    u = np.asarray(nibabel.load(study / "out" / "Load1" / "displacement.nii.gz").dataobj)[:, :, :, 0]
    bone = u[tiny_pair.bone.inside]
    assert np.nanmedian(np.linalg.norm(bone, axis=1)) < 0.5
    moved = np.linalg.norm(tiny_pair.foot_motion.displacement(tiny_pair.bone.points()), axis=1)
    assert np.median(moved) > 1.5


def test_results_on_the_mesh_are_those_of_the_written_transform(results, study):
    """Its bone's motion taken out; strain needs no such care."""
    folder = study / "out" / "Load1"
    alignment = json.loads((folder / "quality.json").read_text())["alignment"]
    bone = RigidMotion(np.array(alignment["rotation"]), np.array(alignment["translation_lps_mm"]))
    written = meshio.read(folder / "mesh.vtu")
    whole = read_transform(folder / "TransformParameters.1.txt")
    for places, values in (
        (written.points, written.point_data),
        (written.points[written.cells[0].data].mean(axis=1), {n: v[0] for n, v in written.cell_data.items()}),
    ):
        total, H = whole.evaluate(places)
        u = bone.inverse().apply(places + total) - places
        assert 0.1 < np.linalg.norm(u, axis=1).max() < np.linalg.norm(total, axis=1).min()
        np.testing.assert_allclose(values["displacement_mm"], u, atol=1e-5)
        strain = StrainField.from_gradient(H)
        np.testing.assert_allclose(values["green_lagrange"].reshape(-1, 3, 3), strain.green_lagrange, atol=1e-5)
        np.testing.assert_allclose(values["max_shear"], strain.max_shear, atol=1e-5)
        np.testing.assert_allclose(values["jacobian"], strain.jacobian, atol=1e-5)
    with (folder / "nodal_displacements.csv").open() as file:
        rows = [[float(r[f"u{axis}_mm"]) for axis in "xyz"] for r in csv.DictReader(file)]
    np.testing.assert_allclose(rows, written.point_data["displacement_mm"], atol=1e-6)


def test_the_aligned_image_is_nearer_to_the_unloaded_one_and_the_registered_nearer_still(results, study, tiny_pair):
    folder = study / "out" / "Load1"
    as_scanned = carry(tiny_pair.loaded, tiny_pair.reference.grid)
    aligned, registered = (
        read_image(folder / f"{name}.nii.gz", allow_missing=True).values for name in ("aligned", "registered")
    )
    fat = tiny_pair.labels.region("fat")
    before, rigid, after = (
        local_correlation(tiny_pair.reference, v, fat)[1] for v in (as_scanned, aligned, registered)
    )
    assert before + 0.1 < rigid
    assert rigid + 0.02 < after


def test_quality_landmarks_noise_floor_and_verdict_are_told_everywhere(results, study):
    told = json.loads((study / "out" / "Load1" / "quality.json").read_text())
    assert told["landmarks"]["count"] > 3
    assert told["noise_floor"]["maer"] > 0
    words = results.cases[0].verdict.words
    assert words in (study / "out" / "report.html").read_text()
    assert any(words in line for line in results.summary())
    verdict = results.cases[0].verdict
    assert told["verdict"] == {"level": verdict.level, "reasons": list(verdict.reasons)}
    again = results.cases[0].measurement()
    assert again.summary() == results.cases[0].summary()
    assert again.quality.landmark_errors_mm.size == told["landmarks"]["count"]
    folder = study / "out" / "Load1"
    names = ("displacement", "green_lagrange", "green_lagrange_plate", "nodal_displacements")
    for name in names:
        assert json.loads((folder / f"{name}.json").read_text())["verdict"] == told["verdict"], name
    for name in ("regions", "intervals"):
        with (folder / f"{name}.csv").open() as file:
            assert {row["verdict"] for row in csv.DictReader(file)} == {words}, name
    (level,) = meshio.read(folder / "mesh.vtu").field_data[VERDICT_FIELD]
    assert ("trust", "caution", "distrust")[level] == verdict.level


def test_the_report_is_one_file_that_fetches_nothing(results, study):
    page = (study / "out" / "report.html").read_text()
    assert "http://" not in page
    assert "https://" not in page
    assert page.count("<script") == 1  # the page's own
    assert len(page) < 12_000_000


def test_row_24_no_header_text_reaches_an_output(results, study):
    for path in (study / "out").rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            if path.name.endswith(".gz"):
                import gzip

                content = gzip.decompress(content)
            assert PATIENT.encode() not in content, path.name


def test_provenance_holds_hashes_versions_parameters_and_no_path(results, study):
    text = (study / "out" / "provenance.json").read_text()
    told = json.loads(text)
    assert told["inputs"]["load0"][0]["name"] == "Load0.nii.gz"
    assert len(told["inputs"]["load0"][0]["sha256"]) == 64
    assert told["versions"]["itk-elastix"].startswith("0.25")
    assert told["machine"]["cores"] == usable_cores()
    assert told["machine"]["processor"]
    assert told["parameters"]["stages"][0]["text"] == QUICK
    assert told["parameters"]["seed"] == 5
    assert str(study) not in text


def test_strain_from_the_written_transform_gives_the_same_maps(results, study):
    again = strain(
        study / "Load0.nii.gz",
        study / "out" / "Load1" / "transform.h5",
        out=study / "strain",
        bone=study / "bone.nii.gz",
    )
    a = read_image(study / "out" / "Load1" / "max_shear.nii.gz", allow_missing=True).values
    b = read_image(study / "strain" / "transform" / "max_shear.nii.gz", allow_missing=True).values
    both = np.isfinite(a) & np.isfinite(b)
    assert both.sum() > 20_000
    np.testing.assert_allclose(b[both], a[both], atol=2e-5)
    assert again.cases[0].verdict.level != "trust"  # no images were compared
    assert again.cases[0].verdict.words in again.summary()[0]


def test_strain_from_a_displacement_image_too(results, study):
    strain(
        study / "Load0.nii.gz",
        study / "out" / "Load1" / "displacement.nrrd",
        out=study / "field",
        bone=study / "bone.nii.gz",
    )
    a = read_image(study / "out" / "Load1" / "max_shear.nii.gz", allow_missing=True).values
    b = read_image(study / "field" / "displacement" / "max_shear.nii.gz", allow_missing=True).values
    both = np.isfinite(a) & np.isfinite(b)
    assert np.median(np.abs(a[both] - b[both])) < 2e-3


@pytest.mark.usefixtures("in_this_process")
def test_a_failing_load_is_named_and_the_others_finish(study, tiny_pair):
    random = np.random.default_rng(3)
    write_image(
        study / "Broken.nii.gz",
        Image(tiny_pair.loaded.grid, random.normal(size=tiny_pair.loaded.grid.shape).astype(np.float32)),
    )
    both = register(
        study / "Load0.nii.gz",
        [study / "Broken.nii.gz", study / "Load1.nii.gz"],
        out=study / "two",
        bone=study / "bone.nii.gz",
        bending=3.0,
        volume=300.0,
        workers=1,
        threads=1,
        chain=True,
    )
    assert list(both.failures) == ["Broken"]
    assert [c.name for c in both.cases] == ["Load1"]
    assert "Broken" in (study / "two" / "report.html").read_text()
    assert not (study / "two" / "Broken").exists()


def test_row_17_outputs_never_replace_inputs(study, tiny_pair, tmp_path):
    inside = tmp_path / "out" / "Load1"
    inside.mkdir(parents=True)
    write_image(inside / "Load1.nii.gz", tiny_pair.loaded)
    with pytest.raises(OutputError, match=r"Load1\.nii\.gz"):
        register(study / "Load0.nii.gz", [inside / "Load1.nii.gz"], out=tmp_path / "out", bone=study / "bone.nii.gz")
    assert (inside / "Load1.nii.gz").is_file()


def test_row_17_an_output_that_cannot_be_a_folder_is_refused_first(study, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="file"):
        register(
            study / "Load0.nii.gz", [study / "Load1.nii.gz"], out=tmp_path / "file" / "out", bone=study / "bone.nii.gz"
        )


def test_one_path_in_place_of_a_list_is_refused(study, tmp_path):
    with pytest.raises(InputError, match="loads must be a list, each item the path of a file"):
        register(study / "Load0.nii.gz", str(study / "Load1.nii.gz"), out=tmp_path / "out", bone=study / "bone.nii.gz")


def test_two_files_of_one_name_are_refused(study, tmp_path):
    with pytest.raises(InputError, match="Load1"):
        register(
            study / "Load0.nii.gz",
            [study / "Load1.nii.gz", study / "Load1.nii.gz"],
            out=tmp_path,
            bone=study / "bone.nii.gz",
        )


def test_row_23_html_in_a_name_is_escaped(study, tiny_pair, tmp_path):
    from dvc.report.page import Section, write_report
    from dvc.trust.verdict import Verdict

    write_report(tmp_path / "r.html", "t", Verdict("trust"), [Section("<script>alert(1)</script>")], [], {"<b>": "<i>"})
    page = (tmp_path / "r.html").read_text()
    assert "<script>alert" not in page
    assert "<i>" not in page


def test_the_command_refuses_with_a_sentence_and_status_2(study, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mrstrain", "register", str(study / "Load0.nii.gz"), str(study / "nowhere.nii.gz"),
         "--bone", str(study / "bone.nii.gz"), "--out", str(tmp_path / "o")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "nowhere.nii.gz" in done.stderr
    assert "Traceback" not in done.stderr
