"""The methods text: figures from the records of what was done, and no paper that was not used."""

from __future__ import annotations

import ast
import json
import re
import sys
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import dvc
from dvc.io.images import read as imagefile
from dvc.registration import engine as nonrigid
from dvc.registration.elastix import engine as elastix
from dvc.registration.elastix.presets import load_preset
from dvc.registration.gauss_newton import fit as gaussnewton
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonWithInterfaces
from dvc.registration.register import Settings
from mrstrain.comparison.methods import methods
from mrstrain.measurement.plan import record_of
from mrstrain.options.measurement import RegistrationOptions, SubjectFiles
from mrstrain.records.inputs import read_subject
from validate import ALL, Criteria

VERSIONS = {"mrstrain": "9.8.7", "itk-elastix": "0.1.2", "SimpleITK": "3.4.5", "nibabel": "5.4", "pydicom": "7.8"}
VERSIONS |= {"pytetwild": "6.7", "isal": "1.9"}


def measured(folder: Path, load: str, align: str = "bone") -> Path:
    place = folder / load
    place.mkdir(parents=True)
    stage = {"name": "heel-mr", "text": load_preset("heel-mr").text}
    record = {"command": "register", "versions": VERSIONS, "parameters": {"align": align, "seed": 5, "stages": [stage]}}
    (place / "provenance.json").write_text(json.dumps(record))
    (place / "quality.json").write_text(json.dumps({"error_of_max_shear": {"source": "A study of 3 heels."}}))
    return place


def simulated(folder: Path, name: str, made: object = None) -> Path:
    place = folder / name
    place.mkdir(parents=True)
    given = {
        "set": name, "title": f"Set of {name}", "laws": {"fat": {"law": "Ogden, mu0 10.54 kPa"}}, "mesh_made": made,
        "fixed": ["bone"], "taped": True, "plate": "rigid", "element": "P1: stabilised",
        "paths": [[{"name": "Load1", "normal_n": 140.0, "shear_n": 0.0}]],
    }  # fmt: skip
    (place / "simulation.json").write_text(
        json.dumps({"command": "simulate", "versions": VERSIONS, "parameters": given})
    )
    return place / "Load1.vtu"


def driven(folder: Path, name: str, of: str) -> Path:
    """A set whose outside goes where it was measured, as `drive` records it."""
    place = folder / name
    place.mkdir(parents=True)
    record = {
        "command": "drive",
        "versions": VERSIONS,
        "set": of,
        "laws": {"fat": "Ogden, mu0 7 kPa"},
        "parameters": {},
    }
    (place / "simulation.json").write_text(json.dumps(record))
    return place / "Load1.vtu"


def levelled(folder: Path, name: str, align: str) -> Path:
    """A model that was sent through the measurement, with the registration of what it would have given."""
    place = folder / f"{name}-levelled"
    place.mkdir(parents=True)
    (place / "provenance.json").write_text(json.dumps({"command": "level", "versions": VERSIONS, "parameters": {}}))
    measured(folder / f"{name}-levelled-work" / "registered" / "Load1", "Load1", align)
    return place / "Load1.vtu"


def told(
    loads: dict[str, Path], models: dict[str, Path], error_known: bool = True, errors: tuple[object, ...] = ()
) -> str:
    bands = {ALL: None} if error_known else {}
    one = SimpleNamespace(fields=SimpleNamespace(points_mm=np.zeros((1234, 3))), bands=bands)
    comparison = SimpleNamespace(loads=(one,), errors=errors)
    return "\n".join(methods(loads, models, comparison, Criteria()))  # type: ignore[arg-type]


def test_how_inputs_were_carried_through_is_told_where_they_were_given(tmp_path: Path) -> None:
    loads, models = {"Load1": measured(tmp_path, "Load1", "bone")}, {"mine": simulated(tmp_path, "mine")}
    exact, both, by_input = (SimpleNamespace(model=name, u_num=num, u_input=given) for name, num, given in (
        ("exact", np.nan, np.nan), ("both", 0.1, 0.2), ("theirs", np.nan, 0.2)))  # fmt: skip
    assert "V&V 20" not in told(loads, models, errors=(exact,))
    words = told(loads, models, errors=(exact, both, by_input))
    assert "inputs of both and theirs and of the mesh of both (grid convergence index, Roache 1994) was" in words
    assert "J Fluids Eng 116(3):405-413" in words
    assert "The uncertainty of the inputs of theirs was" in told(loads, models, errors=(by_input,))
    meshed = SimpleNamespace(model="meshed", u_num=0.1, u_input=np.nan)  # as from `converge`, which varies nothing else
    assert "The uncertainty of the mesh of meshed (grid" in told(loads, models, errors=(exact, meshed))


def test_directions_are_told_where_loads_do_not_share_them(tmp_path: Path) -> None:
    place = simulated(tmp_path, "mine")
    loads = {"Load1": measured(tmp_path / "res", "Load1")}
    down, aside = [[0, 0, 1], [0, -1, 0], [1, 0, 0]], [[0, 1, 0], [0, 0, -1], [1, 0, 0]]
    for other in (down, aside):
        record = json.loads((place.parent / "simulation.json").read_text())
        record["outcome"] = {"Load1": {"plate_axes_lps": down}, "Load2": {"plate_axes_lps": other}}
        (place.parent / "simulation.json").write_text(json.dumps(record))
        text = told(loads, {"mine": place})
        said = "Load2 with the plate's outward normal along (0, 0, -1) and shear along (1, 0, 0) (LPS)"
        assert (said in text) == (other is aside)


def test_figures_and_papers_are_those_of_the_records(tmp_path: Path) -> None:
    loads = {load: measured(tmp_path / "res", load) for load in ("Load1", "Load2")}
    models = {"trebbi": simulated(tmp_path, "trebbi", {"edge_mm": 2.5, "pytetwild": "6.7"})}
    models |= {"mine": simulated(tmp_path, "mine"), "ansys": tmp_path / "ansys" / "Load1.csv"}
    text = told(loads, models)
    assert text.count("registered non-rigidly") == 1  # both loads alike, in one sentence
    for said in (
        "Load1 and Load2: The loaded image was aligned with the unloaded one rigidly on the bone",
        "itk-elastix 0.1.2", "mrstrain 9.8.7", "control points every 4.5 mm",
        "1000, 1000, 1000, 500 iterations of 5000",
        "metric AdvancedNormalizedCorrelation", "seed 5", "pytetwild 6.7", "requested edge length 2.5 mm",
        "trebbi: Set of trebbi (fat: Ogden, mu0 10.54 kPa)", "Load1 140 N normal, 0 N shear", "ansys (csv)",
        "1234 tetrahedra", "from 0.2 to 0.5", "tissue above 0.2, 0.3 and 0.5", "A study of 3 heels.",
        "compared without intervals",
    ):  # fmt: skip
        assert said in text, said
    for paper in (
        "Klein S, Staring M, Murphy",
        "Shamonin DP",
        "Tustison NJ",
        "Hu Y",
        "Trebbi A",
        "Dice LR",
        "Lin LI-K",
        "Bland JM",
    ):
        assert text.count(paper) == 1, paper


def test_our_own_engine_is_told_with_its_weights(tmp_path: Path) -> None:
    for name, bending, weight in (("a", None, "chosen for each pair by cross-validation"), ("b", 2.5, "weight 2.5/mm")):
        place = measured(tmp_path / name, "Load1")
        record = json.loads((place / "provenance.json").read_text())
        record["parameters"] |= {"stages": [], "gauss_newton": asdict(GaussNewton(bending=bending))}
        (place / "provenance.json").write_text(json.dumps(record))
        text = told({"Load1": place}, {"ansys": tmp_path / "Load1.csv"})
        assert "borders" not in text
        for said in (
            "Gauss-Newton engine of mrstrain 9.8.7",
            "every 3.2 mm",
            weight,
            "300/mm3",
            "rigid alignment by Gauss-Newton",
            "doi:10.1023/B:VISI",
        ):
            assert said in text, said
        assert "used as given" not in text.split("Models computed with other")[0]


def test_borders_are_told(tmp_path: Path) -> None:
    place = measured(tmp_path, "Load1")
    record = json.loads((place / "provenance.json").read_text())
    record["parameters"] |= {"stages": [], "engine": "gauss-newton"} | GaussNewtonWithInterfaces().record()
    (place / "provenance.json").write_text(json.dumps(record))
    text = told({"Load1": place}, {"ansys": tmp_path / "Load1.csv"})
    assert "vanishes on the tissue interfaces of the label map" in text
    assert "strain of a tissue named skin (weight chosen for each pair by cross-validation)" in text


def test_a_twin_that_judged_the_error_bars_is_told(tmp_path: Path) -> None:
    loads = {load: measured(tmp_path, load) for load in ("Load1", "Load2")}
    assert "synthetic warp" not in told(loads, {})
    rows = [{"region": "fat", "factor": 1.2}]
    for load, more in (("Load1", {"twin": rows}), ("Load2", {"twin": [], "of_twin": "There is none."})):
        error = {"source": "A study of 3 heels."} | more
        (loads[load] / "quality.json").write_text(json.dumps({"error_of_max_shear": error}))
    assert "The error bars of Load1 were checked by a synthetic warp" in told(loads, {})
    error = {"known": False, "twin": [{"region": "fat", "factor": None}]}  # a pair without error bars
    (loads["Load1"] / "quality.json").write_text(json.dumps({"error_of_max_shear": error}))
    assert "synthetic warp" not in told(loads, {})


def test_driven_and_levelled_models_are_not_those_of_other_programs(tmp_path: Path) -> None:
    loads = {"Load1": measured(tmp_path / "res", "Load1")}
    models = {"mine-driven": driven(tmp_path, "mine-driven", "mine")}
    models |= {"mine-levelled": levelled(tmp_path, "mine", "bone")}
    text = told(loads, models)
    for said in (
        "moved by the measured displacement", "mine-driven: with mrstrain 9.8.7 (fat: Ogden, mu0 7 kPa)",
        "mine-levelled: forward-model comparison", "registered like the measured images.",
    ):  # fmt: skip
        assert said in text, said
    assert "other programs" not in text
    assert "Trebbi" not in text
    text = told(loads, {"x": driven(tmp_path, "trebbi-driven", "trebbi"), "y": levelled(tmp_path, "other", "image")})
    assert "The published material sets are those compiled by Trebbi 2023." in text
    assert "registered as follows. The loaded image was aligned with the unloaded one rigidly on the whole" in text


def test_the_correction_of_shading_is_told_where_it_was_done(tmp_path: Path) -> None:
    models = {"ansys": tmp_path / "Load1.csv"}
    text = told({"Load1": measured(tmp_path, "Load1")}, models)
    assert "removed from both images (N4, Tustison 2010)" in text
    assert text.count("doi:10.1109/TMI.2010.2046908") == 1
    (tmp_path / "given").mkdir()
    assert "Tustison" not in told({"Load1": tmp_path / "given"}, models)


def test_what_is_not_known_is_not_claimed(tmp_path: Path) -> None:
    (tmp_path / "Load1").mkdir()
    text = told({"Load1": tmp_path / "Load1"}, {"ansys": tmp_path / "Load1.csv"}, error_known=False)
    assert "Load1: the displacement was used as given;" in text
    for absent in ("elastix", "SimpleITK", "fTetWild", "Hu Y", "Trebbi", "draws", "Klein"):
        assert absent not in text, absent
    # a set of one's own on a mesh made elsewhere: neither published material sets nor the mesher
    text = told({"Load1": measured(tmp_path, "a", "none")}, {"mine": simulated(tmp_path, "mine")}, error_known=False)
    assert "without rigid alignment" in text
    assert "Hu 2020" not in text
    assert "Trebbi" not in text


def libraries_of(module: str, seen: set[str]) -> set[str]:
    """Libraries that a module of ours imports, or any of ours that it imports."""
    seen.add(module)
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    found = set()
    for node in ast.walk(ast.parse(Path(spec.origin).read_text())):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            if name.split(".")[0] != "dvc":
                found.add(name.split(".")[0])
            elif name not in seen:
                found |= libraries_of(name, seen)
    return found - set(sys.stdlib_module_names)


def with_inputs(folder: Path, *names: str) -> Path:
    """A measurement whose record names the files that it read."""
    place = measured(folder, "Load1")
    record = json.loads((place / "provenance.json").read_text())
    record["inputs"] = {"load0": [{"name": names[0]}], "loads": [{"name": name} for name in names[1:]]}
    record["inputs"]["error_model"] = [{"name": "model.json"}]
    (place / "provenance.json").write_text(json.dumps(record))
    return place


@pytest.mark.parametrize("name", ["Load0.nii.gz", "Load0.nii", "a.nrrd", "a.nhdr", "a.mha", "a.mhd", "series"])
def test_the_libraries_told_are_those_that_read_and_write(tmp_path: Path, name: str) -> None:
    text = told({"Load1": with_inputs(tmp_path, name, name)}, {})
    (sentence,) = re.findall(r"Images \(.*?in a JPEG format; Lowekamp 2013\)\.|Images \(.*?for compression\.", text)
    suffix = imagefile._known_suffix(name)
    reader = "dvc.io.images.dicom" if suffix is None else imagefile._FORMATS[suffix][1].__module__
    used = libraries_of(reader, set()) | libraries_of("dvc.io.images.write", set())
    used -= {"psutil"}  # it only tells whether a process that left a file behind still runs
    assert set(re.findall(r"[\w-]+(?= \d)", sentence)) - {"Lowekamp"} == used - {"numpy"}
    assert sentence.startswith(f"Images ({imagefile.format_of(name)}) were read, and maps (NIfTI, NRRD) were written")
    for library in used - {"numpy"}:
        assert f"{library} {VERSIONS[library]}" in sentence


def test_every_format_that_was_read_is_told(tmp_path: Path) -> None:
    text = told({"Load1": with_inputs(tmp_path, "a.nii.gz", "b.mha", "c.nii.gz", "d")}, {})
    assert "Images (DICOM, MetaImage, NIfTI) were read" in text
    assert "pydicom 7.8" in text


def test_formats_are_those_of_the_record_that_register_makes(tmp_path: Path) -> None:
    grid = dvc.Grid((8, 8, 8), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    values = np.random.default_rng(1).normal(size=grid.shape)
    half = np.zeros(grid.shape, dtype=bool)
    half[:4] = True
    load0, bone, labels = (tmp_path / name for name in ("Load0.nii.gz", "bone.nrrd", "labels.mha"))
    dvc.write_image(load0, dvc.Image(grid, values))
    dvc.write_mask(bone, dvc.Mask(grid, half))
    dvc.write_labels(labels, dvc.LabelMap(grid, half.astype(int), {1: "fat"}))
    subject = read_subject(load0, SubjectFiles(bone=bone, labels=labels, names=tmp_path / "labels.csv"))
    record = record_of(subject, {"loads": [load0]}, Settings.of("gauss-newton"), RegistrationOptions(), {})
    (tmp_path / "provenance.json").write_text(json.dumps(record))
    assert "Images (MetaImage, NIfTI, NRRD) were read" in told({"Load1": tmp_path}, {})


def test_a_levelled_model_counts_as_registered_alike_whatever_files_its_images_came_from(tmp_path: Path) -> None:
    loads = {"Load1": with_inputs(tmp_path / "res", "series0", "series1")}
    assert "registered like the measured images." in told(loads, {"mine-levelled": levelled(tmp_path, "mine", "bone")})


def test_what_the_engine_compares_and_holds_is_told(tmp_path: Path) -> None:
    assert gaussnewton._LEAST_VOXELS == elastix._LEAST_VOXELS == 2.0
    for align, bone in (("bone", True), ("image", False), ("none", False)):
        place = measured(tmp_path / align, "Load1", align)
        assert "mm (or two voxels, if that is larger)" in told({"Load1": place}, {})
        record = json.loads((place / "provenance.json").read_text())
        record["parameters"] |= {"stages": [], "gauss_newton": asdict(GaussNewton())}
        (place / "provenance.json").write_text(json.dumps(record))
        text = told({"Load1": place}, {})
        assert ("strain of the bone (1000/mm3)" in text) == bone
        assert "3.2 mm (or two voxels, if that is larger)" in text
        assert f"all voxels of the tissue and {nonrigid._MASK_MARGIN_MM:g} mm around it" in text
