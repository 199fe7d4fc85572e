"""Error bars are put on where the error is known, and a reason is given where it is not."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import foldnorm

from dvc.deformation.strain_maps import StrainMaps
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.images.noise import noise_of, signal_to_noise
from dvc.images.tissue import widened
from dvc.measurement.error_bars import ErrorBars, TwinCheck, error_bars
from dvc.measurement.judgement import with_caution
from dvc.measurement.page import error_tables, summary_table
from dvc.measurement.subject import LabelsFromImage, Subject
from dvc.registration.elastix.engine import Elastix
from dvc.registration.elastix.presets import load_preset
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonWithInterfaces
from dvc.registration.register import Settings
from dvc.trust.error_model import POOLED, ErrorModel, ErrorTable, error_model_of
from dvc.trust.twin_judgement import judged
from dvc.trust.uncertainty import uncertainty_of
from dvc.trust.verdict import Verdict

GRID = Grid((40, 40, 40), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
NAMES = {1: "Calcaneus", 2: "fat", 3: "Left talus"}


def model(preset: str = "heel-mr", voxel_mm: float = 0.8, snr: float = 25.0, text: str | None = None) -> ErrorModel:
    rows = {POOLED: np.full((2, 1, 2), 0.03), "fat": np.full((2, 1, 2), 0.02)}
    table = ErrorTable(np.full(3, voxel_mm), snr, np.array([0.0, 0.5]), np.zeros(1), rows, (rows,), 4.0)
    used = load_preset("heel-mr").text if text is None else text
    return ErrorModel(preset, hashlib.sha256(used.encode()).hexdigest(), (table,), "made up")


def given(with_labels: bool = True, with_bone: bool = True):
    """A block of tissue in air at SNR 25, with a bone, another bone and fat."""
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[6:34, 6:34, 6:34] = True
    random = np.random.default_rng(0)
    noise = 20.0 * random.standard_normal((2, *GRID.shape))
    image = Image(GRID, np.hypot(np.where(inside, 500.0, 0.0) + noise[0], noise[1]).astype(np.float32))
    labels = np.where(inside, 2, 0)
    labels[6:12, 6:34, 6:34] = 1
    labels[28:34, 6:34, 6:34] = 3
    bone = Mask(GRID, labels == 1) if with_bone else None
    names = LabelMap(GRID, labels, NAMES) if with_labels else None
    subject = Subject(image, bone, None, names, None, np.array([0.0, 0.0, -1.0]), None)
    shear = np.where(inside, 0.1, np.nan).astype(np.float32)
    maps = StrainMaps(GRID, inside, np.zeros((*GRID.shape, 3)), np.zeros((*GRID.shape, 6)), shear, np.ones(GRID.shape))
    settings = Settings.of("heel-mr")
    body = Mask(GRID, inside)
    found = SimpleNamespace(settings=settings, tissue=body, reference=image, loaded=image, unlike_study="")
    return found, subject, maps


def bars_of(found, subject, maps, model, twin=None):
    found.noise = noise_of(found.reference, found.loaded, found.tissue)
    return error_bars(found, subject, maps, model, twin)


def test_skin_of_a_label_map_from_the_image_has_no_intervals_and_the_reason_is_given() -> None:
    """They held too few true values on phantoms; with a label map that a person made, they are given."""
    found, subject, maps = given()
    subject = replace(subject, labels=replace(subject.labels, names=NAMES | {2: "skin"}))
    for made in (None, LabelsFromImage(0.1)):
        bars = bars_of(found, replace(subject, from_image=made), maps, model())
        assert {i.region for i in bars.uncertainty.intervals} == {"skin"}
        assert all(np.isnan(i.low) == (made is not None) for i in bars.uncertainty.intervals)
        assert ("No intervals in skin" in bars.explanation) == (made is not None)


def test_every_bone_is_left_out_whatever_its_name() -> None:
    found, subject, maps = given()
    bars = bars_of(found, subject, maps, model())
    assert bars.uncertainty is not None
    assert {i.region for i in bars.uncertainty.intervals} == {"fat"}
    known = np.isfinite(bars.uncertainty.sigma)
    assert subject.labels is not None
    np.testing.assert_array_equal(known, subject.labels.labels == 2)
    assert np.nanmax(np.abs(bars.uncertainty.sigma - 0.02)) < 1e-6


def test_without_labels_all_but_bone_is_soft_tissue() -> None:
    found, subject, maps = given(with_labels=False)
    bars = bars_of(found, subject, maps, model())
    assert bars.uncertainty is not None
    assert {i.region for i in bars.uncertainty.intervals} == {POOLED}
    assert np.nanmax(np.abs(bars.uncertainty.sigma - 0.03)) < 1e-6


@pytest.mark.parametrize(
    ("used", "labels", "bone", "says"),
    [
        (model("heel-fine"), True, True, "for heel-fine, but the images were registered with heel-mr"),
        (model(voxel_mm=2.0), True, True, "too far"),
        (model(snr=100.0), True, True, "too far"),
        (model(text="(Edited 1)"), True, True, "other parameters"),
        (model(), False, False, "no bone was given"),
    ],
)
def test_where_the_error_is_not_known_the_reason_is_told(used: ErrorModel, labels: bool, bone: bool, says: str) -> None:
    found, subject, maps = given(labels, bone)
    bars = bars_of(found, subject, maps, used)
    assert bars.uncertainty is None
    assert says in bars.explanation
    assert bars.as_dict() == {"known": False, "reason": bars.explanation}
    assert bars.summary == [f"No error bars: {bars.explanation}"]
    assert error_tables(bars) == []


def test_a_muscle_named_after_a_bone_is_no_bone() -> None:
    found, subject, maps = given()
    assert subject.labels is not None
    names = {1: "Calcaneus", 2: "Tibialis posterior", 3: "ankle fat"}
    subject = replace(subject, labels=replace(subject.labels, names=names))
    bars = bars_of(found, subject, maps, model())
    assert bars.uncertainty is not None
    assert {i.region for i in bars.uncertainty.intervals} == {"Tibialis posterior", "ankle fat"}


def test_a_model_of_other_voxels_says_so() -> None:
    found, subject, maps = given()
    own = " x ".join(f"{edge:.2g}" for edge in GRID.spacing_mm)
    assert "these images" not in bars_of(found, subject, maps, model()).explanation
    tables = [replace(t, spacing_mm=tuple(1.3 * edge for edge in t.spacing_mm)) for t in model().tables]
    told = bars_of(found, subject, maps, replace(model(), tables=tuple(tables))).explanation
    assert f"(these images: voxels of {own} mm)" in told


@pytest.mark.parametrize(
    ("voxel", "snr", "far"), [(1.0, 25.0, False), (1.15, 27.0, False), (1.3, 25.0, True), (1.0, 33.0, True)]
)
def test_images_that_are_far_from_those_of_the_error_model_are_told_of_with_the_error_bars(
    voxel: float, snr: float, far: bool
) -> None:
    found, subject, maps = given()
    tables = [replace(t, spacing_mm=voxel * t.spacing_mm, snr=snr) for t in model().tables]
    bars = bars_of(found, subject, maps, replace(model(), tables=tuple(tables)))
    assert ErrorBars.from_dict(bars.as_dict(), bars.uncertainty, bars.model).beyond == bars.beyond
    assert bars.summary == [bars.beyond] * far
    assert summary_table([], (), bars.beyond).note.endswith(bars.beyond)
    assert bool(bars.beyond) == far
    if far:
        own, snr_found = f"{0.8 * voxel:.2g}", round(min(one.snr for one in found.noise))
        assert bars.beyond == (
            f"The error bars were measured on phantoms (voxels of {own} mm, SNR {snr:.0f}); these images have 0.8 mm "
            f"and SNR {snr_found}, so they may cover more or less than 95 %. Measure yours with `mrstrain accuracy "
            f"--preset heel-mr --spacing 0.8 --snr {snr_found} --out DIR`; give its file as --error-model."
        )
        assert len(bars.beyond) <= 3 * 100


@pytest.mark.parametrize(
    ("voxel", "option"),
    [
        ((1.2, 1.2, 1.2), "--spacing 1.2 --snr 14"),
        ((1.0, 1.0, 3.0), "--spacing 1 --slice-spacing 3 --snr 14"),
        ((0.5, 1.2, 1.2), "--spacing 1.2 --slice-spacing 0.5 --snr 14"),
    ],
)
def test_the_way_to_error_bars_for_the_images_is_named_in_full(voxel: tuple[float, float, float], option: str) -> None:
    (table, *_) = model().tables
    told = table.beyond(np.array(voxel), 14.2, "gauss-newton-borders")
    assert f"`mrstrain accuracy --preset gauss-newton-borders {option} --out DIR`" in told
    assert len(told) <= 315  # three lines of a terminal, or a few words more


def test_the_noisier_image_counts() -> None:
    found, subject, maps = given()
    random = np.random.default_rng(1)
    noise = 60.0 * random.standard_normal((2, *GRID.shape))
    found.loaded = Image(GRID, np.hypot(found.reference.values + noise[0], noise[1]).astype(np.float32))
    assert "too far" in bars_of(found, subject, maps, model()).explanation


def test_tissue_outside_the_mask_is_no_air() -> None:
    """With it for air, noise would be a third larger; where no threshold finds the body, noise is not known."""
    found, _, _ = given()
    image, inside = found.reference, found.tissue.inside.copy()
    whole, _ = noise_of(image, image, found.tissue)
    inside[12:] = False
    of_part = Mask(GRID, inside)
    seen, _ = noise_of(image, image, of_part)
    assert seen.in_air == pytest.approx(20.0, rel=0.1)
    assert seen.snr == pytest.approx(whole.snr, rel=0.05)
    assert signal_to_noise(image, of_part) < 0.8 * whole.snr
    assert noise_of(Image(GRID, np.full(GRID.shape, 500.0)), image, of_part)[0].in_air is None


def test_several_stages_have_no_known_error() -> None:
    found, subject, maps = given()
    found.settings = Settings(Elastix((load_preset("heel-mr"), load_preset("heel-mr"))))
    assert "several elastix stages" in bars_of(found, subject, maps, model()).explanation


def test_a_preset_without_a_model_is_told() -> None:
    found, subject, maps = given()
    found.settings = Settings(Elastix((replace(load_preset("heel-mr"), name="mine"),)))
    assert "mine has not been measured" in bars_of(found, subject, maps, None).explanation


def test_without_a_model_of_ones_own_the_built_in_one_of_the_engine_is_taken() -> None:
    found, subject, maps = given()
    assert bars_of(found, subject, maps, None).uncertainty is not None


def test_the_error_of_our_engine_is_that_of_its_own_weights() -> None:
    found, subject, maps = given()
    found.settings = Settings.of("gauss-newton")
    own = model("gauss-newton", text=found.settings.engine.text)
    assert bars_of(found, subject, maps, own).uncertainty is not None
    assert "is for heel-mr" in bars_of(found, subject, maps, model()).explanation
    found.unlike_study = "This pair is unlike any phantom."
    assert bars_of(found, subject, maps, own).explanation == found.unlike_study
    found.settings = Settings(GaussNewton(bending=2.0))
    assert "fixed at 2/mm" in bars_of(found, subject, maps, own).explanation
    found.settings, found.unlike_study = Settings(GaussNewtonWithInterfaces()), ""
    assert "registered with gauss-newton-borders" in bars_of(found, subject, maps, own).explanation
    with_interfaces = model("gauss-newton-borders", text=found.settings.engine.text)
    assert bars_of(found, subject, maps, with_interfaces).uncertainty is not None


def test_an_error_model_is_for_pairs_like_those_of_its_study() -> None:
    _, subject, maps = given()
    body, labels = Mask(GRID, np.isfinite(maps.max_shear)), subject.labels
    pair = AlignedPair(subject.reference, subject.reference, body, body, subject.bone, labels)
    engine, (kept, freed) = (
        GaussNewtonWithInterfaces(),
        (Choice(GaussNewton().weights, "", asked=asked) for asked in (0.01, 0.06)),
    )
    assert engine.unlike_study(pair, kept) == ""
    assert "incompressible phantoms" in engine.unlike_study(pair, freed)
    unlabelled = labels.labels.copy()
    unlabelled[12:20] = 0
    partly = replace(pair, labels=replace(labels, labels=unlabelled))
    assert "of the visible tissue has no label" in engine.unlike_study(partly, kept)
    assert "with a rigid bone" in engine.unlike_study(replace(partly, bone=None), freed)
    generous = widened(body, 3.2)  # air around the tissue has no label, and needs none
    assert np.mean(labels.labels[generous.inside] == 0) > 0.3
    assert engine.unlike_study(replace(pair, body=generous), kept) == ""
    assert "of the visible tissue has no label" in engine.unlike_study(replace(partly, body=generous), kept)


def twin_of(maps: StrainMaps, sd: float, bias: float = 0.03) -> TwinCheck:
    """What comes back with an error of that bias and deviation; the measured shear is made to vary from .05 to .45."""
    maps.max_shear[:] += np.linspace(-0.05, 0.35, GRID.shape[2], dtype=np.float32)
    random = np.random.default_rng(4)
    return TwinCheck((maps.max_shear + bias + sd * random.standard_normal(GRID.shape)).astype(np.float32))


@pytest.mark.parametrize("sd", [0.019, 0.035])
def test_error_bars_that_hold_in_the_pairs_twin_stay_and_others_are_made_wider(sd: float) -> None:
    # the model of fat: bias and deviation .02; the twin's error has the same bias, and its own deviation
    errors = foldnorm(0.02 / sd, scale=sd)
    claimed = np.hypot(0.02, 0.02)
    found, subject, maps = given()
    bars = bars_of(found, subject, maps, model(), twin_of(maps, sd, 0.02))
    alone = bars_of(found, subject, maps, model())
    (row,) = bars.twin
    assert row.region == "fat"
    assert row.held == pytest.approx(errors.cdf(1.96 * claimed), abs=0.01)
    assert 0.88 < row.expected < 0.93  # the fat is small: some hundred places that are 4 mm apart
    assert row.rms_error == pytest.approx(np.hypot(0.02, sd), rel=0.05)
    assert row.bias == pytest.approx(0.02, abs=0.002)
    assert bars.as_dict()["twin"][0]["factor"] == row.factor
    assert error_tables(bars)[1].title.startswith("Check by a synthetic warp")
    if sd < 0.02:
        assert row.factor == 1.0
        assert bars.of_twin == "confirmed by the synthetic warp of this pair."
        assert bars.uncertainty.intervals == alone.uncertainty.intervals
        assert np.isnan(bars.model.tables[0].widening)  # as it was: of one heel
        return
    assert row.factor == pytest.approx(np.sqrt((errors.ppf(0.95) / 1.96) ** 2 - 0.02**2) / 0.02, rel=0.02)
    assert bars.of_twin.startswith("widened by the synthetic warp of this pair: fat 1.")
    assert np.nanmax(bars.uncertainty.sigma) == pytest.approx(0.02 * row.factor, rel=1e-5)
    for now, before in zip(bars.uncertainty.intervals, alone.uncertainty.intervals, strict=True):
        assert now.estimate == before.estimate
        assert now.low <= before.low
        assert now.high >= before.high
    # what `compare` draws truths from is as sure as the least sure tissue, and says so
    assert bars.model.tables[0].widening == pytest.approx(row.factor)
    assert "by the synthetic warp of one pair, and valid for that pair alone" in bars.model.source
    # judged again, the wider error bars hold
    again = twin_of(maps, sd, 0.02).max_shear - maps.max_shear
    inside = np.isfinite(again)
    assert np.mean(np.abs(again[inside]) <= 1.96 * np.hypot(0.02, 0.02 * row.factor)) == pytest.approx(0.95, abs=0.01)


def test_a_percentile_outside_of_its_interval_makes_error_bars_wider_though_voxels_hold() -> None:
    found, subject, maps = given()
    # voxels are off by two deviations all alike: each is within what is claimed of it, and the median is not
    bars = bars_of(found, subject, maps, model(), twin_of(maps, 0.0, 0.04))
    (row,) = bars.twin
    assert row.held == 1.0
    assert row.factor > 1.4
    alone = bars_of(found, subject, maps, model())
    for now, before in zip(bars.uncertainty.intervals, alone.uncertainty.intervals, strict=True):
        assert now.high - now.low >= before.high - before.low


def test_voxels_that_only_the_twin_has_do_not_count() -> None:
    found, subject, maps = given()
    twin = twin_of(maps, 0.01, 0.02)
    maps.max_shear[:, :, :24] = np.nan  # the loaded scan ends there: what is left is the stronger part
    (row,) = bars_of(found, subject, maps, model(), twin).twin
    assert row.factor == 1.0


@pytest.mark.full_size
def test_a_model_as_it_was_made_is_seldom_doubted() -> None:
    # registrations differ in their bias: each alone holds less or more than 95 % of its voxels
    rows = {POOLED: np.stack([np.zeros((1, 2)), np.full((1, 2), 0.03)])}
    biases = np.random.default_rng(7).normal(0.0, 0.02, 40)
    runs = tuple({POOLED: np.stack([np.full((1, 2), b), np.full((1, 2), 0.022)])} for b in biases)
    table = ErrorTable(np.full(3, 0.8), 25.0, np.array([0.0, 0.5]), np.zeros(1), rows, runs, 4.0, widening=2.0)
    shear = np.random.default_rng(0).uniform(0.1, 0.4, (16, 16, 16)).astype(np.float32)
    grid, near, inside = Grid((16, 16, 16), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0)), np.zeros((16, 16, 16)), shear > 0

    def factor(bias: float, sd: float, seed: int) -> float:
        again = (shear + np.random.default_rng(seed).normal(bias, sd, shear.shape)).astype(np.float32)
        sure = uncertainty_of(again, grid, {"fat": inside}, near, table)
        (row,) = judged(shear, again, {"fat": inside}, near, sure, grid.voxel_volume_mm3)
        return row.factor

    assert sum(factor(b, 0.022, k) > 1.0 for k, b in enumerate(biases)) <= 4
    assert factor(0.0, 0.06, 0) > 1.4


def test_without_an_error_model_the_twin_tells_the_least_error() -> None:
    found, subject, maps = given()
    found.settings = Settings(Elastix((replace(load_preset("heel-mr"), name="mine"),)))
    bars = bars_of(found, subject, maps, None, twin_of(maps, 0.05))
    assert bars.uncertainty is None
    (row,) = bars.twin
    assert (row.held, row.factor) == (None, None)
    assert row.rms_error == pytest.approx(np.hypot(0.03, 0.05), rel=0.05)
    (table,) = error_tables(bars)
    assert table.columns == ("region", "error (rms)", "bias")
    assert bars.of_twin.startswith("not known. In the synthetic warp of this pair, the error (rms)")
    assert "is fat 0.05" in bars.of_twin
    found.settings = Settings.of("heel-mr")
    failed = bars_of(found, subject, maps, model(), TwinCheck(None, "The deformation folds."))
    assert failed.twin == ()
    assert failed.of_twin.endswith("the synthetic warp of this pair has no result. The deformation folds.")
    assert failed.uncertainty is not None


def test_a_change_of_volume_that_was_allowed_is_told_in_the_verdict() -> None:
    allowed, kept = (Choice(GaussNewton().weights, "", asked=asked) for asked in (0.06, 0.01))
    doubted = with_caution(Verdict("trust"), allowed)
    assert doubted.level == "caution"
    assert "volume changes of at least 6.0 %" in doubted.reasons[0]
    assert with_caution(Verdict("trust"), kept).level == "trust"
    assert with_caution(Verdict("caution", ("Less alike.",)), allowed).level == "distrust"
    folded = with_caution(Verdict("distrust", ("It folds.",)), allowed)
    assert folded.level == "distrust"
    assert folded.reasons == ("It folds.", doubted.reasons[0])


@pytest.mark.parametrize("name", ["gauss-newton", "gauss-newton-bone", "gauss-newton-borders", "heel-mr"])
def test_our_own_engine_and_the_preset_for_heels_come_with_their_error(name: str) -> None:
    stored = error_model_of(name)
    assert stored is not None
    assert stored.parameters_sha256 == hashlib.sha256(Settings.of(name).engine.text.encode()).hexdigest()
    table = stored.table_for(np.full(3, 0.8), 25.0)
    bias, sd = table.expected("fat", np.array([0.02, 0.3]), np.array([6.0, 0.5], dtype=np.float32))
    assert bias[0] > 0.002  # noise lifts small shears
    assert sd[1] > sd[0] > 0.002
