"""Labels "auto" of `register`: who is told of them."""

from pathlib import Path

import pytest

from dvc import Elastix, Engine, GaussNewton, load_preset, write_image, write_mask
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
    assert next_step(BONE, ("Load1",), Scans(), RegistrationOptions(), GaussNewton()) == NEXT_STEP
    assert next_step(files, cases, scans, how, engine) is None


def test_a_series_without_labels_ends_with_the_next_step(tiny_pair, tmp_path: Path, in_this_process) -> None:
    load0, load1, bone = (tmp_path / f"{name}.nii.gz" for name in ("Load0", "Load1", "bone"))
    write_image(load0, tiny_pair.reference)
    write_image(load1, tiny_pair.loaded)
    write_mask(bone, tiny_pair.bone)
    summary = register(load0, [load1], out=tmp_path / "out", bone=bone, **QUICK).summary()
    assert summary[-2:] == [NEXT_STEP, f"Report: {tmp_path / 'out' / 'report.html'}"]
    assert f"<p>{NEXT_STEP}</p>" in (tmp_path / "out" / "report.html").read_text()
