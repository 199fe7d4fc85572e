"""The table and the sentence on the acquisition: from headers where they tell, else from a person, else not given."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvc import Grid, Image
from mrstrain.measurement.acquisition import NOT_GIVEN, acquisition_section, acquisition_sentence, scans_record
from mrstrain.options.acquisition import AcquisitionOptions

HEADER = {"manufacturer": "Siemens", "field_strength_t": 3.0, "repetition_time_ms": 8.2}
VOXELS = {"matrix": [256, 256, 160], "voxel_mm": [0.8, 0.8, 1.2]}


def folder_of(
    place: Path, load: str, *, more: dict[str, Any] | None = None, floor: bool = True, snr: float = 24
) -> Path:
    """The folder of a measured load, with its records."""
    folder = place / load
    folder.mkdir()
    scans = {"unloaded image": HEADER | VOXELS, load: HEADER | VOXELS | (more or {})}
    record = {
        "command": "register",
        "parameters": {"scans": scans},
        "noise": {"snr": {"unloaded": 25.04, "loaded": snr}},
    }
    (folder / "provenance.json").write_text(json.dumps(record))
    known = {"max_shear_p50": 0.0147, "max_shear_p95": 0.0317, "maer": 0.0065, "sder": 0.0038}
    weights = {"bending": 3.0, "volume": 300.0, "rigidity": 1000.0, "volume_gradient": 0.0}
    quality = {"noise_floor": known if floor else None, "alignment": {"control_spacing_mm": [3.2, 3.2, 3.2]},
               "regularisation": {"weights": weights, "rigidity_of": "bone"}}  # fmt: skip
    (folder / "quality.json").write_text(json.dumps(quality))
    return folder


def rows_of(folders: dict[str, Path], **given: Any) -> dict[str, tuple[str, str]]:
    section = acquisition_section(folders, AcquisitionOptions(**given))
    assert section is not None
    assert section.folded
    return {str(name): (str(value), str(source)) for name, value, source in section.tables[0].rows}


def test_each_value_has_its_source_and_what_nobody_tells_is_not_given(tmp_path: Path) -> None:
    rows = rows_of({"Load1": folder_of(tmp_path, "Load1")}, echo_time_ms=3.7, scanner="Skyra")
    assert rows["Scanner, manufacturer"] == ("Siemens", "header")
    assert rows["Scanner, model"] == ("Skyra", "study file")
    assert rows["Repetition time (TR), ms"] == ("8.2", "header")
    assert rows["Echo time (TE), ms"] == ("3.7", "study file")
    assert rows["Flip angle, degrees"] == (NOT_GIVEN, "")
    assert rows["Matrix of the image, voxels"] == ("256 x 256 x 160", "images")
    assert rows["Voxel size of the image, mm"] == ("0.8 x 0.8 x 1.2", "images")
    assert rows["Signal-to-noise ratio (SNR)"] == ("25 (unloaded image); 24 (Load1)", "images")
    assert rows["Noise floor of max. shear"] == (
        "median 0.0147, 95th percentile 0.0317; MAER 0.0065, SDER 0.0038", "repeat scan",
    )  # fmt: skip
    assert rows["Control point spacing of the displacement, mm"] == ("3.2 x 3.2 x 3.2", "registration")
    assert rows["Regularisation weights"][0] == "bending 3 1/mm, volume 300 1/mm³, strain of the bone 1000 1/mm³"
    assert rows["Spatial resolution of the strain"] == (NOT_GIVEN, "")


def test_images_that_were_acquired_otherwise_and_a_person_who_says_otherwise_are_told(tmp_path: Path) -> None:
    folders = {
        "Load1": folder_of(tmp_path, "Load1"),
        "Load2": folder_of(tmp_path, "Load2", more={"field_strength_t": 1.5}),
    }
    rows = rows_of(folders, manufacturer="GE", noise_floor="0.02", spatial_resolution="9 mm")
    assert rows["Field strength, T"] == ("3 (unloaded image, Load1); 1.5 (Load2)", "header")
    assert rows["Scanner, manufacturer"] == ("Siemens (study file: GE)", "header")
    assert rows["Noise floor of max. shear"][0].endswith("(study file: 0.02)")
    assert rows["Spatial resolution of the strain"] == ("9 mm", "study file")


def test_without_a_repeat_scan_the_noise_floor_is_that_of_the_person(tmp_path: Path) -> None:
    folders = {"Load1": folder_of(tmp_path, "Load1", floor=False)}
    assert rows_of(folders)["Noise floor of max. shear"] == (NOT_GIVEN, "")
    assert rows_of(folders, noise_floor="0.02")["Noise floor of max. shear"] == ("0.02", "study file")


def test_the_methods_text_has_what_is_known_and_says_what_is_not(tmp_path: Path) -> None:
    folders = {"Load1": folder_of(tmp_path, "Load1")}
    told = acquisition_sentence(folders, AcquisitionOptions(sequence_type="3D gradient echo", flip_angle_deg=12.0))
    assert told == (
        "Images were acquired at 3 T (Siemens) with the sequence 3D gradient echo, TR 8.2 ms, flip angle 12 degrees, "
        "voxels of 0.8 x 0.8 x 1.2 mm. Not given: Scanner, model; Sequence, name; Echo time (TE), ms; Matrix of the "
        "acquisition."
    )


def test_a_sentence_takes_the_headers_that_tell_and_names_images_only_where_they_differ(tmp_path: Path) -> None:
    silent = folder_of(tmp_path, "Load1", more=dict.fromkeys(HEADER))
    rows = rows_of({"Load1": silent}, repetition_time_ms=8.2)
    assert rows["Repetition time (TR), ms"] == ("8.2 (unloaded image); not given (Load1)", "header")
    assert acquisition_sentence({"Load1": silent}).startswith(
        "Images were acquired at 3 T (Siemens), TR 8.2 ms, voxels"
    )
    other = folder_of(tmp_path, "Load2", more={"field_strength_t": 1.5})
    told = acquisition_sentence({"Load1": silent, "Load2": other})
    assert told.startswith("Images were acquired at 3 (unloaded image) and 1.5 (Load2) T (Siemens), TR 8.2 ms")


@pytest.mark.parametrize("content", ["{", "[]", '{"parameters": {"scans": 3}, "noise": []}', '{"parameters": null}'])
def test_records_that_tell_nothing_make_no_section_and_no_sentence(tmp_path: Path, content: str) -> None:
    for name in ("provenance.json", "quality.json"):
        (tmp_path / name).write_text(content)
    folders = {"Load1": tmp_path, "Load2": tmp_path / "nowhere"}
    assert acquisition_section(folders) is None
    assert acquisition_sentence(folders) == ""
    assert acquisition_section(folders, AcquisitionOptions(snr=20.0)) is not None


def test_the_record_has_each_image_once_with_what_its_header_tells(tmp_path: Path) -> None:
    image = Image(Grid((4, 5, 6), (0.8, 0.8, 1.2), (0.0, 0.0, 0.0)), np.ones((4, 5, 6), dtype=np.float32))
    (tmp_path / "a.json").write_text('{"EchoTime": 0.0037, "PatientName": "Doe"}')
    record = scans_record((tmp_path / "a.nii.gz", image), {"Load1": (tmp_path / "b.nii.gz", image)})
    voxels = {"matrix": [4, 5, 6], "voxel_mm": [0.8, 0.8, 1.2]}
    assert record == {"scans": {"unloaded image": voxels | {"echo_time_ms": 3.7}, "Load1": voxels}}
