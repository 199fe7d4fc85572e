"""`register --start`: what another tool found is where our own engine begins, without the bone's motion."""

from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk

from dvc.deformation.protocol import Affine, Composed, RigidMotion
from dvc.deformation.strain import StrainField
from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.images.image import Image
from dvc.io.images.write import write_image, write_mask
from dvc.io.transforms.read import read_transform
from dvc.registration.align import motion_of
from mrstrain.measurement.register import register
from tests.textures import GRID, TURNED, everything, pair_of

pytestmark = pytest.mark.usefixtures("in_this_process")

FAR = np.array([14.0, -10.0, 9.0])
SHIFT = np.array([1.3, -0.6, 0.7])


def test_a_field_of_another_tool_is_refined(tmp_path):
    """Images 19 mm apart, which nothing finds from nothing; the field is 1.6 mm off, and does not tell its frame."""
    fixed, near = pair_of(Affine(np.eye(3), SHIFT), 0.05)
    write_image(tmp_path / "Load0.nii.gz", fixed)
    write_image(tmp_path / "Load1.nii.gz", Image(TURNED.moved_by(np.eye(3), FAR), near.values))
    write_mask(tmp_path / "body.nii.gz", everything())
    field = sitk.GetImageFromArray(np.tile((FAR * [-1.0, -1.0, 1.0]).astype(np.float32), (8, 8, 8, 1)), isVector=True)
    corners = GRID.points_at(np.array([[0.0, 0.0, 0.0], np.array(GRID.shape) - 1.0]))
    field.SetOrigin(corners.min(axis=0).tolist())
    field.SetSpacing((np.ptp(corners, axis=0) / 7.0).tolist())
    sitk.WriteImage(field, tmp_path / "theirs.nii.gz")
    X = GRID.points(everything().inside)

    def off_mm(name: str, **given) -> float:
        register(
            tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / name, align="none",
            tissue=tmp_path / "body.nii.gz", bending=3.0, volume=0.0, threads=1, **given,
        )  # fmt: skip
        found = read_transform(tmp_path / name / "Load1" / "transform.h5").displacement(X)
        return float(np.nanmedian(np.linalg.norm(found - SHIFT - FAR, axis=1)))

    assert off_mm("refined", start=tmp_path / "theirs.nii.gz", start_frame="RAS") < 0.4
    assert off_mm("from nothing") > 3.0


def test_the_bones_motion_is_taken_out_of_it_and_a_repeat_scan_has_none(small_pair, tmp_path, monkeypatch):
    write_image(tmp_path / "Load0.nii.gz", small_pair.reference)
    write_image(tmp_path / "Load1.nii.gz", small_pair.loaded)
    again = small_pair.loaded.values.copy()
    again[0, 0, 0] += 1.0
    write_image(tmp_path / "again.nii.gz", Image(small_pair.loaded.grid, again))
    write_mask(tmp_path / "bone.nii.gz", small_pair.bone)
    foot = RigidMotion(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, 4.0, -5.0]))
    rising = Affine(np.eye(3) + np.diag([0.0, 0.0, 0.1]), np.zeros(3))
    begun = {}

    def never(reference, loaded, *, start, **_):
        begun[float(loaded.values[0, 0, 0])] = start
        raise RegistrationError("enough")

    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", never)
    monkeypatch.setattr("mrstrain.measurement.strain.read_transform", lambda _: Composed([rising, foot]))
    (tmp_path / "theirs.h5").write_bytes(b"")
    given = {"bone": tmp_path / "bone.nii.gz", "start": tmp_path / "theirs.h5", "repeat": tmp_path / "again.nii.gz"}
    with pytest.raises(RegistrationError):
        register(tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "o", **given)
    assert begun[float(again[0, 0, 0])] is None
    left = begun[float(small_pair.loaded.values[0, 0, 0])]
    assert np.abs(motion_of(left, small_pair.bone).displacement(small_pair.bone.points())).max() < 1e-6
    X = small_pair.bone.points()[::50]
    kept, whole = (StrainField.from_gradient(d.evaluate(X)[1]).green_lagrange for d in (left, rising))
    np.testing.assert_allclose(kept, whole, atol=1e-9)


def test_what_cannot_be_a_start_is_refused_first(small_pair, tmp_path):
    for name in ("Load0", "Load1", "Load2"):
        write_image(tmp_path / f"{name}.nii.gz", small_pair.reference)
    write_mask(tmp_path / "bone.nii.gz", small_pair.bone)
    one, two = [tmp_path / "Load1.nii.gz"], [tmp_path / "Load1.nii.gz", tmp_path / "Load2.nii.gz"]
    for loads, given, kind, said in (
        (two, {"start": tmp_path / "theirs.h5"}, InputError, "^start is for a single loaded image, but 2 are given"),
        (
            one,
            {"start": tmp_path / "theirs.h5", "preset": "heel-mr"},
            ParameterError,
            "^start is only for",
        ),
        (one, {"start": tmp_path / "theirs.h5"}, InputError, "no such transform file"),
        (one, {"start": tmp_path / "theirs.h5", "start_frame": "RAS"}, InputError, "transform files are always in LPS"),
        (one, {"start_frame": "RAS"}, ParameterError, "^start_frame needs start, which is not given"),
    ):
        with pytest.raises(kind, match=said):
            register(tmp_path / "Load0.nii.gz", loads, out=tmp_path / "o", bone=tmp_path / "bone.nii.gz", **given)
    assert not (tmp_path / "o").exists()
