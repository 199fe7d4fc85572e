"""A byte order mark, which editors on Windows put at the beginning of a text, changes nothing."""

from __future__ import annotations

import codecs
import pickle
from pathlib import Path

import pytest

from mrstrain.models.variant_files import VARIANT, VariantRecord, variant_folders
from tests.fuzz.readers import READERS

TYPED = {".toml", ".csv", ".json", ".txt", ".ctbl", ".fcsv", ".inp"}  # by a person, in a text editor


def typed(folder: Path, reader: str) -> list[Path]:
    """The files of a reader, in a new folder, that may be typed or corrected in an editor."""
    READERS[reader].write(folder)
    return [path for path in sorted(folder.glob(READERS[reader].damaged)) if path.suffix in TYPED]


@pytest.mark.parametrize(
    "reader",
    ["names", "elastix-transform", "elastix-parameters", "matrix", "landmarks", "abaqus",
     "nodal-table", "model", "curves", "materials", "thresholds", "study", "measurement", "scan-parameters",
     "noise-floor", "error-model", "error-table"],
)  # fmt: skip
def test_a_byte_order_mark_is_left_out(reader: str, tmp_path: Path) -> None:
    files = typed(tmp_path, reader)
    assert files
    for file in files:
        read = READERS[reader].read
        without = pickle.dumps(read(file))
        file.write_bytes(codecs.BOM_UTF8 + file.read_bytes())
        assert pickle.dumps(read(file)) == without, file.name


def test_a_byte_order_mark_of_a_variant_is_left_out(tmp_path: Path) -> None:
    record = VariantRecord(model="half", input="force", steps=1.0)
    (tmp_path / VARIANT).write_bytes(codecs.BOM_UTF8 + record.text.encode())
    assert [one.record for one in variant_folders([tmp_path])] == [record]
