"""Labels "auto" of `register`: who is told of them, and what strokes do."""

import html
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from dvc import (
    Elastix,
    Engine,
    GaussNewton,
    LabelMap,
    TissueLabels,
    load_preset,
    write_image,
    write_labels,
    write_mask,
)
from dvc.errors import InputError
from dvc.labelling.near_marks import certain
from mrstrain.measurement import label as labelling
from mrstrain.measurement.auto_labels import NEXT_STEP, next_step
from mrstrain.measurement.register import register
from mrstrain.options.measurement import RegistrationOptions, Scans, SubjectFiles

BONE = SubjectFiles(bone=Path("bone.nii.gz"))
QUICK = {"bending": 3.0, "volume": 300.0}


@pytest.mark.parametrize(
    ("files", "scans", "how", "engine", "cases"),
    [
        (SubjectFiles(), Scans(), RegistrationOptions(align="image"), GaussNewton(), ("Load1",)),
        (
            SubjectFiles(labels=Path("tissues.nii.gz"), bone_label="bone"),
            Scans(), RegistrationOptions(), GaussNewton(), ("Load1",),
        ),
        (BONE, Scans(allow_missing=True), RegistrationOptions(), GaussNewton(), ("Load1",)),
        (BONE, Scans(), RegistrationOptions(preset="heel-mr"), Elastix((load_preset("heel-mr"),)), ("Load1",)),
        (BONE, Scans(), RegistrationOptions(borders=False), GaussNewton(), ("Load1",)),
        (BONE, Scans(), RegistrationOptions(), GaussNewton(), ("labels",)),
    ],
    ids=["no bone", "labels given", "missing voxels", "elastix", "one smooth spline", "load of that name"],
)  # fmt: skip
def test_nobody_is_told_of_labels_that_cannot_be_made_or_would_not_help(
    files: SubjectFiles, scans: Scans, how: RegistrationOptions, engine: Engine, cases: tuple[str, ...]
) -> None:
    assert next_step(BONE, ("Load1",), Scans(), RegistrationOptions(), GaussNewton(), 0.8) == NEXT_STEP
    assert next_step(BONE, ("Load1",), Scans(), RegistrationOptions(), GaussNewton(), 2.4) is None
    assert next_step(files, cases, scans, how, engine, 0.8) is None


@pytest.fixture
def images(tiny_pair, tmp_path: Path) -> tuple[Path, Path, Path]:
    """An unloaded and a loaded image, and the mask of the bone."""
    load0, load1, bone = (tmp_path / f"{name}.nii.gz" for name in ("Load0", "Load1", "bone"))
    write_image(load0, tiny_pair.reference)
    write_image(load1, tiny_pair.loaded)
    write_mask(bone, tiny_pair.bone)
    return load0, load1, bone


def strokes(tiny_pair, place: Path, **centres: str) -> Path:
    """Strokes of so many names, each in the innermost voxels of a tissue; with a table of names."""
    labels, drawn = tiny_pair.labels, np.zeros(tiny_pair.labels.grid.shape, dtype=np.int64)
    for number, tissue in enumerate(centres.values(), 1):
        deep = distance_transform_edt(labels.region(tissue).inside & (drawn == 0))
        drawn[deep > 0.8 * deep.max()] = number
    write_labels(place, LabelMap(labels.grid, drawn, dict(enumerate(centres, 1))))
    return place


def test_a_series_without_labels_ends_with_the_next_step(
    images, tmp_path: Path, in_this_process, monkeypatch: pytest.MonkeyPatch
) -> None:
    load0, load1, bone = images
    monkeypatch.setattr("mrstrain.measurement.auto_labels._FINE_MM", 2.5)  # than the voxels of the pair
    summary = register(load0, [load1], out=tmp_path / "out", bone=bone, **QUICK).summary()
    assert summary[-2:] == [NEXT_STEP, f"Report: {tmp_path / 'out' / 'report.html'}"]
    assert f"<p>{NEXT_STEP}</p>" in html.unescape((tmp_path / "out" / "report.html").read_text())


def test_a_series_makes_its_labels_from_strokes_without_a_mask(
    images, tiny_pair, tmp_path: Path, in_this_process, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bone of the voxels of these images is not found from a stroke: labels as they would be."""
    load0, load1, _ = images
    asked: list[object] = []

    def labels(*given: object) -> TissueLabels:
        asked.extend(given[1:4])
        return TissueLabels(tiny_pair.labels, certain(tiny_pair.labels))

    monkeypatch.setattr(labelling, "label_tissues", labels)
    marks = strokes(tiny_pair, tmp_path / "strokes.nii.gz", Bone="bone", fat="fat", muscle="muscle")
    given = {"marks": marks, "mark_names": tmp_path / "strokes.csv", "labels": "auto", "borders": False, **QUICK}
    series = register(load0, [load1], out=tmp_path / "out", **given)
    bone, body, marked = asked
    assert bone is None
    assert body is None
    assert list(marked.names.values()) == ["Bone", "fat", "muscle"]
    record = json.loads((tmp_path / "out" / "Load1" / "provenance.json").read_text())
    assert record["parameters"]["bone_label"] == "bone"  # as it is called in the label map
    assert {"labels", "marks", "mark_names"} <= set(record["inputs"])
    assert "bone" not in record["inputs"]
    assert NEXT_STEP not in series.summary()


@pytest.mark.parametrize(
    ("centres", "given", "told"),
    [
        ({"fat": "fat"}, {}, "no stroke is named like a bone"),
        ({"talus": "bone", "tibia": "bone"}, {}, "strokes in several bones: talus, tibia"),
        ({"talus": "bone"}, {"bone_label": "tibia"}, "no region 'tibia'; it has talus"),
        ({"talus": "bone"}, {"bone_label": "talus", "bone": True}, "without the mask `bone`"),
        ({"talus": "bone"}, {"labels": None}, "are for labels auto"),
        ({"talus": "bone"}, {"marks": None, "bone": True}, "`mark_names` needs strokes"),
    ],
)
def test_strokes_that_make_no_label_map_are_refused_first(
    images, tiny_pair, tmp_path: Path, centres: dict[str, str], given: dict[str, object], told: str
) -> None:
    load0, load1, bone = images
    marks = strokes(tiny_pair, tmp_path / "strokes.nii.gz", **centres)
    options = {"labels": "auto", "marks": marks, "mark_names": tmp_path / "strokes.csv", **given}
    with pytest.raises(InputError, match=told):
        register(load0, [load1], out=tmp_path / "out", **options | ({"bone": bone} if given.get("bone") else {}))
    assert not (tmp_path / "out").exists()
