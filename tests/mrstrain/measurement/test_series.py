"""Several loads in one call, chained or at once, one of them failing: none disturbs another."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from dvc.deformation.bspline import BSpline
from dvc.errors import InputError, OutputError, RegistrationError
from dvc.images.image import Image, Mask
from dvc.images.noise import noise_of
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_labels, write_mask
from dvc.io.transforms.elastix_text import parse_parameters
from dvc.registration.align import Alignment
from dvc.registration.elastix.engine import Elastix
from dvc.registration.elastix.presets import Preset
from dvc.registration.gauss_newton.fit import control_grid, spline_through
from dvc.registration.register import Registration, Settings, register as register_pair
from dvc.report.page import Section
from dvc.trust.quality import NoiseFloor
from dvc.trust.verdict import Verdict
from dvc.worker import Worker
from mrstrain.measurement.case import Case
from mrstrain.measurement.plan import Plan, Registered
from mrstrain.measurement.register import Series, register
from phantoms import Heel, pressed, scan
from tests.processes import tasks_run_here
from tests.quick import QUICK


@pytest.fixture(scope="module")
def scans(tmp_path_factory, tiny_pair) -> Path:
    """An unloaded heel and others in its frame: three loads, one of turned contrast, and a repeat scan."""
    folder = tmp_path_factory.mktemp("series")
    heel, foot = Heel(3), tiny_pair.foot_motion
    less = scan(heel, tiny_pair.loaded.grid, pressed(heel, 0.3), foot, snr=25.0, number=5)
    values = less.values.copy()
    values[0, 0, 0] += 1.0
    other = replace(less, values=values)
    turned = replace(less, values=less.values.max() - less.values)
    back = foot.inverse()
    loads = {"Load1": tiny_pair.loaded, "Load2": less, "Load3": other, "Turned": turned, "again": tiny_pair.repeat}
    for name, image in loads.items():
        grid = image.grid.moved_by(back.rotation, back.translation_mm)
        write_image(folder / f"{name}.nii.gz", Image(grid, image.values))
    write_image(folder / "Load0.nii.gz", tiny_pair.reference)
    write_mask(folder / "bone.nii.gz", tiny_pair.bone)
    write_labels(folder / "tissues.nrrd", tiny_pair.labels)
    return folder


@dataclass
class Spy:
    """In the place of the registration of a pair: keeps what each was started from, and fails on turned contrast."""

    scans: Path
    spline: BSpline
    asked: list[tuple[str, BSpline | None]]
    bones: list[Mask | None]
    found: dict[str, BSpline]

    def register(self, reference, loaded, *, start, settings, bone, tissue, **_) -> Registration:
        name = next(
            path.name.removesuffix(".nii.gz")
            for path in self.scans.glob("*.nii.gz")
            if path.name != "bone.nii.gz" and np.array_equal(read_image(path).values, loaded.values)
        )
        self.asked.append((name, start))
        self.bones.append(bone)
        if name == "Turned":
            raise RegistrationError("turned")
        found = self.found[name] = replace(self.spline)
        noise = noise_of(reference, loaded, tissue)[0]
        alignment = Alignment(np.nan, "bone", 0.5, 0.9, 0.01, np.zeros(3))  # type: ignore[arg-type]
        return Registration(reference, loaded, tissue, bone, alignment, found, settings, 1.0, (noise, noise))


@pytest.fixture
def spy(monkeypatch, scans, tiny_pair, in_this_process) -> Spy:
    control = control_grid(tiny_pair.reference.grid, np.full(3, 8.0))
    one = Spy(scans, BSpline(control, spline_through(tiny_pair.deformation, control)), [], [], {})
    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", one.register)

    def written(_plan: Plan, folder: Path, _done: Registered, _floor: NoiseFloor | None) -> tuple[Case, None]:
        return Case(folder, Section(folder.name, Verdict("trust")), (), ""), None

    monkeypatch.setattr(Plan, "write", written)
    monkeypatch.setattr("mrstrain.measurement.register.measured_strain", lambda *_: [])  # nothing was written
    return one


@pytest.mark.parametrize("chain", [True, False])
def test_each_load_of_a_chain_starts_from_the_last_good_one(spy, scans, tmp_path, chain):
    loads = [scans / f"{name}.nii.gz" for name in ("Load1", "Turned", "Load2", "Load3")]
    series = register(
        scans / "Load0.nii.gz", loads, out=tmp_path, bone=scans / "bone.nii.gz", repeat=scans / "again.nii.gz",
        chain=chain, workers=1,
    )  # fmt: skip
    assert series.failures == {"Turned": "turned"}
    assert [name for name, _ in spy.asked] == ["again", "Load1", "Turned", "Load2", "Load3"]
    begun_at = dict(spy.asked)
    assert begun_at["again"] is None  # unloaded: it is far from every load
    assert begun_at["Load1"] is None
    assert begun_at["Turned"] is (spy.found["Load1"] if chain else None)
    assert begun_at["Load2"] is (spy.found["Load1"] if chain else None)
    assert begun_at["Load3"] is (spy.found["Load2"] if chain else None)


def test_results_of_an_earlier_run_are_not_replaced_in_silence(spy, scans, tmp_path):
    loads, notes = [scans / f"{name}.nii.gz" for name in ("Load1", "Load2")], list[str]()

    def told(case: str, stage: str, _: float) -> None:
        notes.extend([stage] * (case == "note"))

    def registered() -> list[str]:
        notes.clear()
        register(scans / "Load0.nii.gz", loads, out=tmp_path, bone=scans / "bone.nii.gz", workers=1, progress=told)
        return list(notes)

    assert registered() == []
    for name in ("Load1", "Old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "quality.json").write_text("{}")
    assert registered() == [
        f"{tmp_path} holds results of an earlier run. Replaced: Load1. Kept, not part of this run: Old."
    ]
    shutil.rmtree(tmp_path / "Load1")
    assert registered() == [f"{tmp_path} holds results of an earlier run. Kept, not part of this run: Old."]


def test_where_no_load_is_registered_no_folder_is_left(spy, scans, tmp_path):
    given = {"bone": scans / "bone.nii.gz", "workers": 1}
    with pytest.raises(RegistrationError, match="turned"):
        register(scans / "Load0.nii.gz", [scans / "Turned.nii.gz"], out=tmp_path / "of" / "mine", **given)
    assert list(tmp_path.iterdir()) == []
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "notes.txt").write_text("mine")
    with pytest.raises(RegistrationError, match="turned"):
        register(scans / "Load0.nii.gz", [scans / "Turned.nii.gz"], out=kept, **given)
    assert [path.name for path in kept.iterdir()] == ["notes.txt"]


def test_the_bone_may_be_a_label_of_the_map(spy, scans, tmp_path, tiny_pair):
    given = {"labels": scans / "tissues.nrrd", "names": scans / "tissues.csv", "out": tmp_path / "out"}
    register(scans / "Load0.nii.gz", [scans / "Load1.nii.gz"], bone_label="bone", **given)
    (bone,) = spy.bones
    np.testing.assert_array_equal(bone.inside, tiny_pair.bone.inside)
    with pytest.raises(InputError, match=r"Name the label of the bone in tissues\.nrrd"):
        register(scans / "Load0.nii.gz", [scans / "Load1.nii.gz"], **given)
    with pytest.raises(InputError, match="calcaneum"):
        register(scans / "Load0.nii.gz", [scans / "Load1.nii.gz"], bone_label="calcaneum", **given)
    with pytest.raises(InputError, match="given twice"):
        register(
            scans / "Load0.nii.gz", [scans / "Load1.nii.gz"], bone=scans / "bone.nii.gz", bone_label="bone", **given
        )


@pytest.mark.parametrize(("load0", "load"), [("Load0", "copy"), ("Load1", "copy"), ("Load2", "Load0")])
def test_row_8_one_image_given_twice_is_refused_before_anything_is_made(spy, scans, tmp_path, load0, load):
    """The copy is of Load0 or of another load; or a load is the unloaded image itself."""
    shutil.copy(scans / f"{'Load0' if load0 == 'Load0' else 'Load1'}.nii.gz", tmp_path / "copy.nii.gz")
    second = tmp_path / "copy.nii.gz" if load == "copy" else scans / f"{load}.nii.gz"
    loads = [scans / "Load1.nii.gz", scans / "Load2.nii.gz", second]
    with pytest.raises(InputError, match=rf"{load}\.nii\.gz are the same image: all voxels are equal"):
        register(scans / "Load0.nii.gz", loads, out=tmp_path / "out", bone=scans / "bone.nii.gz")
    assert not (tmp_path / "out").exists()
    assert not spy.asked


def test_row_17_a_disk_too_small_for_all_loads_is_told_first(spy, scans, tmp_path, monkeypatch):
    """101,000 voxels at 54 bytes: 6 MB for each image."""
    arguments = {"out": tmp_path / "new" / "out", "bone": scans / "bone.nii.gz"}
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 7 * 10**6))
    both = [scans / "Load1.nii.gz", scans / "Load2.nii.gz"]
    with pytest.raises(OutputError, match="the results of 2 images need about 12 MB, but the disk has only 7 MB left"):
        register(scans / "Load0.nii.gz", both, **arguments)
    assert not (tmp_path / "new").exists()
    assert register(scans / "Load0.nii.gz", both[:1], **arguments).cases


@pytest.mark.full_size
def test_loads_at_once_are_those_one_after_the_other_bit_for_bit(scans, tmp_path):
    """A load and a repeat scan, a failing load beside; two workers and one, on equal threads."""

    def results(workers: int) -> tuple[Series, dict[str, bytes], dict[str, object]]:
        out = tmp_path / str(workers)
        series = register(
            scans / "Load0.nii.gz",
            [scans / f"{name}.nii.gz" for name in ("Turned", "Load1")],
            out=out,
            repeat=scans / "again.nii.gz",
            align="none",
            bending=4.0,
            volume=300.0,
            workers=workers,
            threads=1,
        )
        quality = {c.name: json.loads((out / c.name / "quality.json").read_text()) for c in series.cases}
        for told in quality.values():
            del told["alignment"]["seconds"]
        return series, {c.name: (out / c.name / "displacement.nrrd").read_bytes() for c in series.cases}, quality

    series, fields, quality = results(2)
    with tasks_run_here():
        again, same_fields, same_quality = results(1)
    for one in (series, again):
        assert list(one.failures) == ["Turned"]
        assert "correlate negatively" in one.failures["Turned"]
        assert [case.name for case in one.cases] == ["Load1", "repeat"]
    assert fields == same_fields
    assert len(set(fields.values())) == 2
    assert quality == same_quality
    floors = [quality[name]["noise_floor"] for name in ("Load1", "repeat")]
    assert floors[0] == floors[1] is not None  # the repeat scan's, whichever was finished first


@pytest.mark.full_size
def test_row_26_two_threads_give_the_same_bits_again(tiny_pair):
    settings = Settings(Elastix((Preset("quick", QUICK, parse_parameters(QUICK)),)), threads=2)
    with Worker(threads=2) as worker:
        one, two = (
            register_pair(tiny_pair.reference, tiny_pair.loaded, bone=tiny_pair.bone, settings=settings, worker=worker)
            for _ in range(2)
        )
    np.testing.assert_array_equal(one.displacement.coefficients_mm, two.displacement.coefficients_mm)
    np.testing.assert_array_equal(one.alignment.motion.rotation, two.alignment.motion.rotation)
    np.testing.assert_array_equal(one.alignment.motion.translation_mm, two.alignment.motion.translation_mm)
    assert np.abs(one.displacement.coefficients_mm).max() > 0.5
