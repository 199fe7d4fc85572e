"""Marks: bones found from a stroke, tissues that brightness alone does not find, and corrections that stay near."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from dvc import Grid, Image, LabelMap, Mask, label_tissues
from dvc.arrays import BoolArray
from dvc.errors import InputError
from dvc.labelling.marks import corrected, grown
from tests.dvc.labelling.test_tissues import dice

GRID = Grid((40, 40, 40), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
SPACING = GRID.spacing_mm
NAMES = {1: "Calcaneus", 2: "fat", 3: "muscle", 4: "skin", 5: "tendon", 6: "ankle"}


def strokes(labels: LabelMap, counts: dict[int, int]) -> LabelMap:
    """Strokes of 12 mm inside the tissues of a label map, so many of each."""
    random, drawn = np.random.default_rng(6), np.zeros_like(labels.labels)
    for number, count in counts.items():
        deep = distance_transform_edt(labels.labels == number, sampling=labels.grid.spacing_mm)
        inner = np.argwhere(deep > min(2.0, 0.6 * deep.max()))
        for centre in inner[random.integers(len(inner), size=count)]:
            along = np.eye(3)[random.integers(3)]
            for step in np.arange(-6.0, 6.0, 0.5):
                at = tuple(np.rint(centre + along * step / labels.grid.spacing_mm).astype(int))
                if all(0 <= a < n for a, n in zip(at, drawn.shape, strict=True)) and labels.labels[at] == number:
                    drawn[at] = number
    return LabelMap(labels.grid, drawn, {number: NAMES[number] for number in counts})


def test_a_heel_is_labelled_from_ten_strokes(heel_at_rest_once) -> None:
    image, truth = heel_at_rest_once(31, 1.2)
    made = label_tissues(image, marks=strokes(truth, {1: 1, 2: 4, 3: 3, 4: 2}))
    assert set(made.labels.names.values()) == {"Calcaneus", "fat", "muscle", "skin", "other bone"}
    known = {name: truth.region(name).inside for name in truth.names.values()}
    assert dice(made.labels.region("Calcaneus").inside, known["bone"]) > 0.93
    assert dice(made.labels.region("fat").inside, known["fat"]) > 0.92
    assert dice(made.labels.region("muscle").inside, known["muscle"] | known["tendon"]) > 0.92


def test_a_mark_of_a_bone_outside_of_one_is_refused(heel_at_rest_once) -> None:
    image, truth = heel_at_rest_once(31, 2.0)
    grid = truth.grid
    in_fat = LabelMap(grid, (strokes(truth, {2: 1}).labels > 0).astype(int), {1: "talus"})
    with pytest.raises(InputError, match="The mark of talus is not in marrow"):
        label_tissues(image, marks=in_fat)
    with pytest.raises(InputError, match="A bone is needed"):
        label_tissues(image, marks=LabelMap(grid, in_fat.labels, {1: "fat"}))
    with pytest.raises(InputError, match="A bone is needed"):
        label_tissues(image)


def test_marks_that_cannot_be_used_are_told() -> None:
    """Of one tissue below no skin, with a bone that is given: another name of it needs no second bone."""
    radius = np.linalg.norm(GRID.points() - GRID.centre_mm, axis=-1)
    values = np.where(radius < 17.0, 500.0, 0.0) + np.random.default_rng(9).normal(0.0, 10.0, GRID.shape)
    drawn = np.select([radius < 2.0, (radius > 9.0) & (radius < 11.0), (radius > 15.0) & (radius < 16.0)], [1, 2, 3], 0)
    marks = LabelMap(GRID, drawn, {1: "Calcaneus", 2: "tendon", 3: "skin"})
    made = label_tissues(Image(GRID, values), Mask(GRID, radius < 5.0), marks=marks)
    assert set(made.labels.names.values()) == {"bone", "fat"}
    told = "\n".join(made.notes)
    assert "strokes of tendon were not used" in told
    assert "strokes of skin were not used" in told
    assert "Calcaneus" not in told


def cords() -> tuple[np.ndarray, BoolArray, BoolArray]:
    """Muscle with two dark cords of 5 voxels across."""
    i, j = GRID.points()[..., 0], GRID.points()[..., 1]
    one, other = (np.hypot(i - at, j - at) < 2.6 for at in (10, 28))
    values = np.where(one | other, 120.0, 400.0) + np.random.default_rng(7).normal(0.0, 40.0, GRID.shape)
    return values.astype(np.float32), one, other


def test_a_tissue_is_found_where_it_is_joined_to_its_mark_and_no_further() -> None:
    values, one, _ = cords()
    mark = one & (np.arange(40) == 20)
    everywhere = np.ones(GRID.shape, dtype=bool)
    found = grown(values, mark, everywhere, 400.0, SPACING)
    assert dice(found > 0.5, one) > 0.95
    assert found[mark].min() == 1.0
    assert np.array_equal(
        grown(np.full_like(values, 400.0), mark, everywhere, 410.0, SPACING) > 0.5, mark
    )  # no contrast
    assert not grown(values, np.zeros_like(mark), everywhere, 400.0, SPACING).any()


@pytest.mark.parametrize("spacing_mm", [(1.0, 1.0, 1.0), (0.8, 0.8, 1.6), (0.6, 2.0, 0.6)])
def test_a_correction_follows_the_image_and_stays_near_its_mark(spacing_mm: tuple[float, float, float]) -> None:
    grid = Grid(GRID.shape, spacing_mm, (0.0, 0.0, 0.0))
    i = np.broadcast_to(np.arange(40)[:, None, None], grid.shape)
    values = np.where(i < 20, 400.0, 600.0) + np.random.default_rng(8).normal(0.0, 20.0, grid.shape)
    wrong = np.stack([i < 26, i >= 26]).astype(np.float32)  # the border lies 6 voxels off
    mark = np.zeros(grid.shape, dtype=bool)
    mark[21:25, 20, 20] = True
    where = np.ones(grid.shape, dtype=bool)
    found = corrected(values.astype(np.float32), wrong, where, {1: mark}, grid)
    assert found.sum(axis=0) == pytest.approx(1.0, abs=1e-6)
    away_mm = distance_transform_edt(~mark, sampling=spacing_mm)
    assert np.array_equal(found[:, away_mm > 8.0], wrong[:, away_mm > 8.0])
    assert np.mean((found[1] > 0.5) == (i >= 20), where=away_mm < 4.0) > 0.99
    assert (away_mm[found[1] != wrong[1]]).max() > 7.0
    same = corrected(values.astype(np.float32), wrong, where, {0: (i < 26) & mark}, grid)
    assert np.array_equal(same, wrong)  # marks that agree change nothing


def test_a_tissue_that_no_mark_is_about_stays_where_the_image_shows_no_edge() -> None:
    i = np.broadcast_to(np.arange(40)[:, None, None], GRID.shape)
    values = np.random.default_rng(8).normal(400.0, 20.0, GRID.shape).astype(np.float32)
    given = np.stack([i < 20, (i >= 20) & (i < 26), i >= 26]).astype(np.float32)
    mark = np.zeros(GRID.shape, dtype=bool)
    mark[22:24, 18:22, 18:22] = True
    found = corrected(values, given, np.ones(GRID.shape, dtype=bool), {0: mark}, GRID)
    assert found[0][mark].min() == 1.0
    assert (found.argmax(axis=0) != given.argmax(axis=0)).sum() > 2 * mark.sum()
    assert np.array_equal(found[2], given[2])
