"""Every damaged file that once was read wrongly, escaped, hung or crashed is refused, wherever that can be told.

`corpus.zip` has a folder for each kind of file. A file's name begins with what happened: EXC (an error that is none of
ours), HANG, CRASH, TRUNC (a file that was cut was read with less in it), CHECKSUMMED (packed data of other values),
NONFINITE (NaN or infinity taken as a number).
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from dvc.errors import InputError
from fe.simulation_files import read_checkpoint
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.true_error import read_errors
from tests.fuzz.readers import READERS, REGISTERED, STAGE

CORPUS = Path(__file__).with_name("corpus.zip")
FILES = [name for name in zipfile.ZipFile(CORPUS).namelist() if not name.endswith("/")]
READ = {
    "abaqus": "abaqus", "ansys": "ansys", "curves": "curves", "dicom": "dicom", "displacement": "displacement",
    "frd": "calculix", "gmsh": "gmsh", "landmarks": "landmarks", "materials": "materials", "matrix": "matrix",
    "measurement": "measurement", "meta": "metaimage", "modeltoml": "model", "names": "names", "nodal": "nodal-table",
    "npz_borders": "interface-spline", "nrrd": "nrrd", "param": "elastix-parameters", "segnrrd": "labels",
    "study": "study", "thresholds": "thresholds", "transform_itk": "itk-transform", "vtu": "vtk", "xplt": "febio",
}  # fmt: skip
OWN: dict[str, Callable[[Path], object]] = {
    "errorcsv": partial(read_errors, outcomes=REGISTERED),
    "ledger": lambda path: Ledger(path.parents[1], path.parents[1]).finished(STAGE),
    "npz_restart": partial(read_checkpoint, made_from="key"),
}  # files of our own that a run makes again: a damaged one is no error, and is not used
BESIDE = {"nodal": "heel.csv", "measurement": "quality.json"}  # files that others belong to, and their name there
NOTHING_TO_TELL = {
    "whole, read at once": ["abaqus/HANG5s_9dd26427", "abaqus/HANG5s_eb321789", "xplt/HANG5s_cb42fb47"],
    "cut at the end of a line, with no count of lines": [
        "ansys/TRUNC-ACCEPTED_00c05a8e", "ansys/TRUNC-ACCEPTED_6ee28476", "curves/TRUNC-ACCEPTED_a0b084d7",
        "curves/TRUNC-ACCEPTED_e35953bb", "landmarks/TRUNC-ACCEPTED_b9bcb8cb", "materials/TRUNC-ACCEPTED_126fb25b",
        "materials/TRUNC-ACCEPTED_e987a049", "names/TRUNC-ACCEPTED_d497c420", "study/TRUNC-ACCEPTED_72cea8d4",
    ],
    "cut after a text in quotes, or everything is": [
        "modeltoml/TRUNC-ACCEPTED_81f828a5", "modeltoml/TRUNC-ACCEPTED_9ee821b0", "modeltoml/TRUNC-ACCEPTED_da39a3ee",
    ],
    "cut within a comment": [
        "param/TRUNC-ACCEPTED_2cb9b766", "param/TRUNC-ACCEPTED_32ee85ce", "param/TRUNC-ACCEPTED_385f34c6",
        "param/TRUNC-ACCEPTED_a22509a4", "param/TRUNC-ACCEPTED_b70c7fb8", "param/TRUNC-ACCEPTED_d8e821f7",
    ],
    "another valid number or name where there is no checksum": [
        "nrrd/CHECKSUMMED-CHANGED_5e3dfc6e", "nrrd/CHECKSUMMED-CHANGED_69027348", "nrrd/CHECKSUMMED-CHANGED_b3905ad6",
        "transform_itk/CHECKSUMMED-CHANGED_051d7421", "transform_itk/CHECKSUMMED-CHANGED_5206b2d5",
        "transform_itk/CHECKSUMMED-CHANGED_79a38b14", "transform_itk/CHECKSUMMED-CHANGED_883c113e",
        "vtu/CHECKSUMMED-CHANGED_a8d277e6", "vtu/CHECKSUMMED-CHANGED_da4f3ab1",
    ],
}  # fmt: skip
TAKEN = {name for names in NOTHING_TO_TELL.values() for name in names}


def placed(name: str, folder: Path) -> Path:
    """A file of the corpus in a folder, with what belongs to it."""
    kind, called = name.split("/")
    path = folder / called.split("_", 2)[2]
    if kind in BESIDE:
        READERS[READ[kind]].write(folder)
        path = folder / BESIDE[kind]
    if kind == "ledger":
        path = folder / ".study" / f"{STAGE.name}.json"
        path.parent.mkdir()
    if path.suffix in (".nhdr", ".mhd"):
        path.with_suffix(".raw").write_bytes(bytes(20_000))
    path.write_bytes(zipfile.ZipFile(CORPUS).read(name))
    return path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_is_refused_where_it_can_be_told(name: str, tmp_path: Path) -> None:
    path, kind = placed(name, tmp_path), name.split("/", maxsplit=1)[0]
    if kind in OWN:
        assert not OWN[kind](path)
    elif name.rpartition("_" + path.name)[0] in TAKEN:
        READERS[READ[kind]].read(path)
    else:
        with pytest.raises(InputError, match=path.name):
            READERS[READ[kind]].read(path)


def test_what_cannot_be_told_is_in_the_corpus() -> None:
    assert not [name for name in TAKEN if not any(file.startswith(name) for file in FILES)]
