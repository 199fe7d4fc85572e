"""What commands are given beside the golden inputs, made once for all tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import SimpleITK as sitk

import mrstrain
from tests.golden.scenes import GIVEN

CURVE = "test,stretch,nominal_stress_kpa\n" + "".join(f"uniaxial,{1 - n / 50},{-n / 20}\n" for n in range(20))


@pytest.fixture(scope="module")
def made(made_once: Callable[..., Path]) -> Path:
    """What the commands are given beside the golden inputs: a stretch, its strain, a model driven by it ..."""
    subject = {"labels": GIVEN / "tissues.nii.gz", "names": GIVEN / "tissues.csv", "bone_label": "bone"}

    def fill(folder: Path) -> None:
        stretched = sitk.AffineTransform((1.01, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.99), (0.0, 0.0, 0.0))
        sitk.WriteTransform(stretched, str(folder / "Load1.tfm"))
        mrstrain.strain(GIVEN / "Load0.nii.gz", folder / "Load1.tfm", out=folder / "strain", **subject)
        mrstrain.drive(
            GIVEN / "pad.inp", folder / "strain", out=folder, sets=[str(GIVEN / "materials.toml")], threads=1
        )
        (folder / "curve.csv").write_text(CURVE)
        labels = sitk.ReadImage(str(GIVEN / "tissues.nii.gz"))
        sitk.WriteImage(sitk.Cast(labels == 1, sitk.sitkUInt8), str(folder / "bone.nii.gz"))

    return made_once("one-run-in-a-folder", fill)
