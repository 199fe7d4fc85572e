"""The table of readers: every kind of file that a user gives, or that a command reads again, as small valid files."""

from __future__ import annotations

import itertools
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import SimpleITK as sitk
from pydicom.uid import RLELossless

import dvc
import fe
import validate
from dvc.deformation.interface_spline import Interfaces, InterfaceSpline
from dvc.io.images.labels import read_names
from dvc.io.images.scan_parameters import read_scan_parameters
from dvc.io.transforms.interface_spline import write_interface_spline
from dvc.io.transforms.read import read_displacement
from dvc.io.transforms.write import write_elastix_transform, write_itk_transform
from dvc.registration.elastix import presets
from dvc.trust.error_model import error_model_of, read_error_model
from dvc.trust.landmarks import read_landmarks
from dvc.trust.quality import NoiseFloor, read_noise_floor
from fe.simulation_files import read_checkpoint, write_checkpoint
from mrstrain.comparison.model_files import IN_IMAGE, model_files
from mrstrain.options.modelling import ModelReading
from mrstrain.records.inputs import read_matrix
from mrstrain.records.measured_with import MeasuredWith
from mrstrain.studies.file import read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.plan import Stage
from mrstrain.studies.stages import StageResult
from mrstrain.studies.true_error import read_errors, write_errors
from phantoms import TissueError
from tests.dicomfiles import write_classic, write_enhanced
from tests.dvc.io.transforms.test_itk import MOTION, spline
from tests.fe.solving import solved
from tests.fe.test_simulate import ALONG, DOWN, LAWS, dome
from tests.fuzz.damage import Reader
from tests.meshfiles import TAGS, block, written as write_mesh
from tests.validate.test_comparison import case, cube, error_table, labels as cube_labels, result, sheared
from validate.location import read_thresholds
from validate.run_end import early_end

GRID = dvc.Grid((6, 7, 8), (1.5, 1.2, 1.0), (-8.0, 3.0, 5.0))
VALUES = np.random.default_rng(1).integers(0, 1000, GRID.shape).astype(np.int16)
VECTORS = np.random.default_rng(2).normal(size=(*GRID.shape, 3))
SPLINE = spline(np.eye(3))
FREE = fe.Plate(DOWN, ALONG)
LOADS = [fe.LoadStep("Load1", 1.0)]
STAGE = Stage("made", {}, (), ())
REGISTERED = {"register Load1": SimpleNamespace(record=SimpleNamespace(made_utc="2026-01-01"))}
CODES = Path(__file__).parents[1] / "validate" / "codes.zip"
POINTS = {"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": [
    {"id": "1", "label": "a", "position": [1.0, 2.0, 3.0], "positionStatus": "defined"},
]}]}  # fmt: skip
TEXTS = {
    "a.csv": 'label,name\n1,bone\n2,"muscle, deep"\n',
    "a.txt": '0 0 0 0 0 0 0 "Clear Label"\n1 255 0 0 1 1 1 "bone"\n',
    "a.ctbl": "# Color table\n0 Background 0 0 0 0\n1 bone 200 100 100 255\n",
    "curves.csv": "test,stretch,nominal_stress_kpa\nuniaxial,0.9,-1.5\nuniaxial,0.8,-4\nequibiaxial,1.1,2e0\n",
    "landmarks.csv": "name,x0,y0,z0,x1,y1,z1\na,1,2,3,1.5,2,3\nb,4,5,6,4.5,5,6e0\n",
    "landmarks.fcsv": "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n1,1.0,2.0,3.0,0,0,0,1,1,1,0,a,,\n",
    "landmarks.mrk.json": json.dumps(POINTS),
    "materials.toml": (Path(fe.__file__).parent / "published.toml").read_text(encoding="utf-8"),
    "matrix.txt": "1 0 0 5\n0 1 0 6.5\n0 0 1 7e0\n0 0 0 1\n",
    "model.toml": IN_IMAGE + 'mesh = "a.inp"\n',
    "parameters.txt": presets.load_preset("heel-mr").text,
    "study.toml": '[study]\nname = "Heel"\n[images]\nload0 = "Load0.nii.gz"\nlabels = "t.nii.gz"\n[loads.Load1]\n'
    'image = "Load1.nii.gz"\nnormal_n = 140\nshear_n = 4.5e1\n[models]\nsets = ["trebbi"]\nlimit_minutes = 20\n',
    "thresholds.csv": 'max_shear,source\n0.2,"A 2001"\n0.5,"B, 2002"\n',
}


def _of_text(read: Callable[[Path], object], *names: str) -> Reader:
    def write(folder: Path) -> None:
        for name in names:
            (folder / name).write_text(TEXTS[name], encoding="utf-8")

    return Reader(write, read)


def _of_image(read: Callable[[Path], object], values: np.ndarray, *names: str, damaged: str = "*.*") -> Reader:
    def write(folder: Path) -> None:
        image = sitk.GetImageFromArray(values.swapaxes(0, 2), isVector=values.ndim == 4)
        image.SetSpacing(GRID.spacing_mm.tolist())
        for name in names:
            sitk.WriteImage(image, str(folder / name), useCompression="packed" in name)

    return Reader(write, read, damaged)


def _of_mesh(*kinds: str) -> Reader:
    def write(folder: Path) -> None:
        for kind in kinds:
            (folder / kind).mkdir()
            write_mesh(folder / kind, kind)

    return Reader(write, dvc.read_mesh)


def _of_code(ending: str, *runs: str) -> Reader:
    def write(folder: Path) -> None:
        with zipfile.ZipFile(CODES) as packed:
            for name in packed.namelist():
                if Path(name).stem in runs and name.endswith((ending, ".inp", ".log", ".feb")):
                    (folder / Path(name).name).write_bytes(packed.read(name))

    return Reader(write, partial(_read_run, ending))


def _read_run(ending: str, path: Path) -> None:
    early_end(path.with_suffix(ending))
    validate.read_result("model", path.with_suffix(ending))


def _write_dicom(folder: Path) -> None:
    write_classic(folder / "series", [("1", "0")] * 8)
    write_enhanced(folder / "enhanced.dcm")
    write_enhanced(folder / "packed.dcm", syntax=RLELossless)


def _read_dicom(path: Path) -> None:
    dvc.read_image(path.parent if path.parent.name == "series" else path)


def _write_itk_transforms(folder: Path) -> None:
    for name in ("a.h5", "a.tfm"):
        write_itk_transform(folder / name, SPLINE, MOTION)
    sitk.WriteTransform(sitk.Euler3DTransform((2.0, -1.0, 3.0), 0.1, -0.2, 0.3), str(folder / "a.mat"))


def _write_interface_spline(folder: Path) -> None:
    tissues = np.repeat([0, 1], 6)[:, None, None] * np.ones((12, 12, 12), dtype=int)
    interfaces = Interfaces.between(dvc.Grid((12, 12, 12), (2.0,) * 3, (-11.0,) * 3), tissues, 0, 6.0)
    write_interface_spline(folder / "a.npz", InterfaceSpline(SPLINE, SPLINE, interfaces))


def _write_vtk(folder: Path) -> None:
    points, cells = block()
    mesh = meshio.Mesh(points, [("tetra", cells)], {"displacement": 0.01 * points})
    for binary, name in itertools.product((False, True), ("vtu", "vtk")):
        getattr(meshio, name).write(folder / f"{binary}.{name}", mesh, binary=binary)


def _write_nodal_table(folder: Path) -> None:
    rows = ["node,ux,uy,uz", *(f"{tag},0.{tag},-1e-2,0" for tag in TAGS)]
    write_mesh(folder, "inp").with_suffix(".csv").write_text("\n".join(rows) + "\n")


def _read_nodal_table(path: Path) -> object:
    return validate.read_result("model", path.with_suffix(".csv"), mesh=path.with_suffix(".inp"))


def _read_model(path: Path) -> object:
    path.with_name("Load1.csv").touch()
    return model_files(["Load1"], [path.parent], ModelReading())


def _read_landmarks(path: Path) -> object:
    return read_landmarks(path if path.suffix == ".csv" else (path, path))


def _write_measurement(folder: Path) -> None:
    subject = dvc.Subject(dvc.Image(GRID, VALUES.astype(np.float32)), tissue=dvc.Mask(GRID, VALUES >= 0))
    stretch = dvc.Affine(np.diag([1.1, 1.0, 1.0]), np.zeros(3))
    record = {"inputs": {"load0": [{"name": "a.nii", "sha256": "0"}]}, "parameters": {"engine": "elastix"}}
    dvc.Measurement.from_deformation(stretch, subject, name="Load1").write(folder, record)


def _read_measurement(path: Path) -> object:
    return str(dvc.Measurement.read(path.parent)), MeasuredWith.read(path.parent)


def _write_error_table(folder: Path) -> None:
    errors = {"Load1": [TissueError("fat", 9, *np.linspace(0.1, 0.7, 7), 0)]}
    write_errors(folder / "error.csv", errors, REGISTERED)


def _read_simulation(path: Path) -> None:
    fe.Simulation.read(path.parent)


def _write_checkpoint(folder: Path) -> None:
    state = solved(dome((2, 2, 2)), LAWS, FREE, LOADS)[0]
    write_checkpoint(folder / "a.npz", state.checkpoint, "key")


def _read_named_mesh(path: Path) -> None:
    fe.read_tet_mesh(path.with_suffix(".vtu"))


def _read_ledger(path: Path) -> None:
    Ledger(path.parents[1], path.parents[1]).finished(STAGE)


def _write_scan_parameters(folder: Path) -> None:
    told = {"Manufacturer": "Siemens", "MagneticFieldStrength": 3, "FlipAngle": 8.5, "RepetitionTime": 0.011,
            "EchoTime": 0.00495, "ScanningSequence": "GR", "SequenceName": "fl3d1"}  # fmt: skip
    (folder / "a.json").write_text(json.dumps(told))
    write_enhanced(folder / "enhanced.dcm")


def _read_scan_parameters(path: Path) -> object:
    return read_scan_parameters(path.with_suffix(".nii") if path.suffix == ".json" else path)


def _write_comparison(folder: Path) -> None:
    mesh = cube(3)
    cases = [case("Load1", sheared(0.4), [result("half", mesh, sheared(0.2))], error_table(0.0, 0.01))]
    validate.compare(cases, cube_labels()).write(folder)


def _read_comparison(path: Path) -> None:
    str(validate.Comparison.read(path.parent))


READERS: Mapping[str, Reader] = {
    "nifti": _of_image(dvc.read_image, VALUES, "a.nii", "packed.nii.gz"),
    "nrrd": _of_image(dvc.read_image, VALUES, "a.nrrd", "packed.nrrd", "b.nhdr", damaged="*.n*"),
    "metaimage": _of_image(dvc.read_image, VALUES, "a.mha", "packed.mha", "b.mhd", damaged="*.m*"),
    "dicom": Reader(_write_dicom, _read_dicom),
    "labels": Reader(
        lambda folder: dvc.write_labels(folder / "a.seg.nrrd", dvc.LabelMap(GRID, VALUES % 3, {1: "bone", 2: "fat"})),
        dvc.read_labels,
        "*.nrrd",
    ),
    "names": _of_text(read_names, "a.csv", "a.txt", "a.ctbl"),
    "displacement": _of_image(partial(read_displacement, frame="LPS"), VECTORS, "a.nrrd", "a.mha", "packed.mha"),
    "elastix-transform": Reader(
        lambda folder: write_elastix_transform(folder, SPLINE, MOTION, GRID), dvc.read_transform
    ),
    "itk-transform": Reader(_write_itk_transforms, dvc.read_transform),
    "interface-spline": Reader(_write_interface_spline, dvc.read_transform),
    "elastix-parameters": _of_text(presets.read_parameter_file, "parameters.txt"),
    "matrix": _of_text(read_matrix, "matrix.txt"),
    "landmarks": _of_text(_read_landmarks, "landmarks.csv", "landmarks.fcsv", "landmarks.mrk.json"),
    "abaqus": _of_mesh("inp"),
    "ansys": _of_mesh("cdb"),
    "gmsh": _of_mesh("msh-22", "msh-41", "msh-41-binary"),
    "vtk": Reader(_write_vtk, partial(validate.read_result, "model")),
    "calculix": _of_code(".frd", "c3d8", "c3d10", "fails"),
    "febio": _of_code(".xplt", "tet4", "hex20", "fails"),
    "nodal-table": Reader(_write_nodal_table, _read_nodal_table),
    "named-mesh": Reader(lambda folder: fe.write_tet_mesh(folder / "a.vtu", dome((2, 2, 2))), _read_named_mesh),
    "model": _of_text(_read_model, "model.toml"),
    "curves": _of_text(fe.read_curves, "curves.csv"),
    "materials": _of_text(fe.read_material_sets, "materials.toml"),
    "thresholds": _of_text(read_thresholds, "thresholds.csv"),
    "study": _of_text(read_study, "study.toml"),
    "ledger": Reader(
        lambda folder: Ledger(folder, folder).keep(STAGE, "key", {"files": []}, StageResult(("x", "y")), 1.5),
        _read_ledger,
    ),
    "measurement": Reader(_write_measurement, _read_measurement, "*.*"),
    "scan-parameters": Reader(_write_scan_parameters, _read_scan_parameters),
    "noise-floor": Reader(
        lambda folder: (folder / "quality.json").write_text(
            json.dumps({"noise_floor": asdict(NoiseFloor(*np.linspace(0.01, 0.05, 5).tolist()))})
        ),
        read_noise_floor,
    ),
    "comparison": Reader(_write_comparison, _read_comparison, "*.[cj]*"),
    "error-model": Reader(lambda folder: error_model_of("heel-mr").write(folder / "a.json"), read_error_model),
    "error-table": Reader(_write_error_table, partial(read_errors, outcomes=REGISTERED)),
    "simulation": Reader(
        lambda folder: fe.simulate(dome((2, 2, 2)), LAWS, FREE, LOADS).write(folder), _read_simulation, "*.[vcj]*"
    ),
    "checkpoint": Reader(_write_checkpoint, partial(read_checkpoint, made_from="key")),
}
