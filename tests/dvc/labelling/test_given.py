"""What masks and marks may ask of the labels, and what is refused: a ball of fat, muscle and skin with two bones."""

from functools import cache

import numpy as np
import pytest

from dvc import Grid, Image, LabelMap, Mask, TissueLabels, label_tissues
from dvc.arrays import BoolArray
from dvc.errors import InputError
from dvc.labelling.marks import corrected

GRID = Grid((48, 48, 48), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
ONE, OTHER = (-9.5, 0.0, 5.0), (9.5, 0.0, 5.0)


def ball(centre_mm: tuple[float, ...], radius_mm: float) -> BoolArray:
    return np.asarray(np.linalg.norm(GRID.points() - GRID.centre_mm - centre_mm, axis=-1) < radius_mm)


def body(fat: float = 600.0, muscle: float = 300.0) -> Image:
    """Muscle above fat in a ball of 22 mm, below 2 mm of skin, with two bones of 7.5 mm."""
    values = np.where((GRID.points() - GRID.centre_mm)[..., 2] > -2.0, muscle, fat)
    values[~ball((0.0, 0.0, 0.0), 20.0)] = 200.0
    values[~ball((0.0, 0.0, 0.0), 22.0)] = 0.0
    for centre in (ONE, OTHER):
        values[ball(centre, 7.5)] = 60.0
        values[ball(centre, 6.0)] = fat + 50.0
    return Image(GRID, values + np.random.default_rng(3).normal(0.0, 15.0, values.shape))


BONE = Mask(GRID, ball(ONE, 7.5))


@cache
def plain() -> TissueLabels:
    """The body labelled from its bone alone."""
    return label_tissues(body(), BONE)


def marks(**where: BoolArray) -> LabelMap:
    names = dict(enumerate((name.replace("_", " ") for name in where), 1))
    return LabelMap(GRID, np.select(list(where.values()), list(names), 0), names)


def volumes(made: TissueLabels) -> dict[str, int]:
    return {name: int((made.labels.labels == number).sum()) for number, name in made.labels.names.items()}


def test_a_bone_that_is_given_stays_as_it_is_whatever_is_marked() -> None:
    """Strokes run over the border of its mask."""
    over = ball((-9.5, 0.0, 12.5), 2.0)
    for name in ("bone", "calcaneus", "muscle", "fat"):
        made = label_tissues(body(), BONE, marks=marks(**{name: over}))
        assert np.array_equal(made.labels.region("bone").inside, BONE.inside), name
        assert made.probability.sum(axis=0)[made.labels.labels > 0] == pytest.approx(1.0, abs=1e-5)
        if name != "fat":  # what the marks say was found without them
            assert volumes(made) == volumes(plain()), name


def test_a_mark_of_another_bone_needs_its_own_name_where_the_bone_is_given() -> None:
    with pytest.raises(InputError, match=r"outside the mask of the bone\. If they mark another bone"):
        label_tissues(body(), BONE, marks=marks(bone=ball(OTHER, 2.0)))
    made = label_tissues(body(), BONE, marks=marks(talus=ball(OTHER, 2.0)))
    assert made.labels.region("talus").inside.sum() == pytest.approx(ball(OTHER, 7.5).sum(), rel=0.03)


def test_two_names_for_one_bone_are_refused() -> None:
    both = marks(calcaneus=ball(ONE, 2.0), talus=ball(OTHER, 2.0), navicular=ball((9.5, 0.0, 8.0), 1.2))
    with pytest.raises(InputError, match="No dark rim separates navicular from talus"):
        label_tissues(body(), marks=both)


def test_other_bones_stay_where_one_of_them_is_marked_as_that() -> None:
    small = Mask(GRID, ball((0.0, 9.0, -9.0), 4.0))
    plain = label_tissues(body(), small)
    made = label_tissues(body(), small, marks=marks(other_bone=ball(OTHER, 2.0)))
    assert volumes(plain)["other bone"] == pytest.approx(2 * ball(OTHER, 7.5).sum(), rel=0.03)
    assert volumes(made) == volumes(plain)


def test_marks_outside_the_body_are_told_and_tell_nothing() -> None:
    air = ~ball((0.0, 0.0, 0.0), 25.0) & ball((-22.0, -22.0, -22.0), 5.0)
    plain = label_tissues(body(), BONE)
    for name, alone in (("tendon", True), ("muscle", False)):
        others = {} if alone else {"fat": ball((0.0, 0.0, -12.0), 2.0)}
        made = label_tissues(body(), BONE, marks=marks(**{name: air}, **others))
        assert made.notes == (
            f"The strokes of {name} were not used: they lie outside the body, or in the mask of the bone.",
        )
        assert volumes(made) == volumes(plain)


def test_marked_fat_that_is_darker_than_muscle_is_told() -> None:
    fat, muscle = ball((0.0, 0.0, -12.0), 3.0), ball((0.0, 0.0, 3.0), 3.0)
    notes = label_tissues(body(), BONE, marks=marks(fat=muscle, muscle=fat)).notes
    assert any("the image is not brighter than where muscle is marked" in note for note in notes)
    assert not label_tissues(body(), BONE, marks=marks(fat=fat, muscle=muscle)).notes


def test_a_bone_as_dark_as_muscle_tells_of_suppressed_fat() -> None:
    notes = label_tissues(body(fat=300.0, muscle=600.0), BONE).notes
    assert any("If fat is suppressed in this image" in note for note in notes)
    assert not plain().notes


def test_a_bone_outside_the_body_is_refused() -> None:
    with pytest.raises(InputError, match="Only 0 % of the mask of the bone is inside the body"):
        label_tissues(body(), Mask(GRID, ball((-20.0, -20.0, -20.0), 4.0)))


def test_probabilities_sum_to_one_where_no_walk_reaches_a_mark() -> None:
    """A second part of the body within 8 mm of a mark, with nothing around it: it stays as it was."""
    where = np.zeros(GRID.shape, dtype=bool)
    where[4:20, 4:40, 4:40] = where[23:25, 20:24, 20:24] = True
    found = np.stack([where, np.zeros_like(where)]).astype(np.float32)
    values = np.random.default_rng(4).normal(400.0, 20.0, GRID.shape).astype(np.float32)
    mark = np.zeros_like(where)
    mark[17:20, 21, 21] = True
    made = corrected(values, found, where, {1: mark}, GRID)
    assert made.sum(axis=0)[where] == pytest.approx(1.0, abs=1e-6)
    assert np.array_equal(made[:, 23:25], found[:, 23:25])
    assert made[1][mark].min() == 1.0


def test_nothing_is_labelled_where_the_image_ends_and_holes_are() -> None:
    """The cut through the body is no surface with skin."""
    values = body().values.copy()
    values[36:] = values[10, 20:22, 20:22] = np.nan
    made = label_tissues(Image(GRID, values), BONE)
    assert not made.labels.labels[36:].any()
    assert not made.probability[:, 36:].any()
    assert made.labels.labels[10, 20:22, 20:22].all()
    assert np.mean(made.labels.labels[:36] == plain().labels.labels[:36]) > 0.98
