"""A label map that is given, corrected near marks: what changes, what is kept bit for bit, and what marks mean."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from dvc import Image, LabelMap, Mask, correct_labels, label_tissues, labels_from
from dvc.arrays import BoolArray
from dvc.errors import InputError
from dvc.labelling import carried
from dvc.labelling.carried import CarriedLabels
from dvc.labelling.near_marks import certain
from tests.dvc.labelling.test_given import BONE, GRID, ONE, OTHER, ball, body, marks, volumes

IN_FAT, NEAR_SKIN = (0.0, 0.0, -10.0), (0.0, 0.0, -16.5)
REACH_MM = 8.0


def truth() -> LabelMap:
    """Bones, fat, muscle and skin of `body`, the bones as one label."""
    above = (GRID.points() - GRID.centre_mm)[..., 2] > -2.0
    labels = np.where(ball((0.0, 0.0, 0.0), 20.0), np.where(above, 3, 2), 4)
    labels[ball(ONE, 7.5) | ball(OTHER, 7.5)] = 1
    labels[~ball((0.0, 0.0, 0.0), 22.0)] = 0
    return LabelMap(GRID, labels, {1: "calcaneus", 2: "fat", 3: "muscle", 4: "skin"})


def spoilt(where: BoolArray, number: int = 3) -> LabelMap:
    right = truth()
    return LabelMap(GRID, np.where(where & (right.labels == 2), number, right.labels), right.names)


@pytest.mark.parametrize("centre", [IN_FAT, NEAR_SKIN])
def test_a_mark_takes_back_what_is_wrong_and_leaves_all_else(centre: tuple[float, float, float]) -> None:
    given, mark = spoilt(ball(centre, 4.5)), ball(centre, 1.5)
    made = correct_labels(body(), given, marks=marks(fat=mark))
    assert made.labels.names == given.names
    assert np.mean(made.labels.labels != truth().labels) < 0.1 * np.mean(given.labels != truth().labels)
    changed = made.labels.labels != given.labels
    assert made.changed == np.mean(changed[given.labels > 0])
    assert set(given.labels[changed]) == {3}  # skin beside it is of no concern to the mark
    assert not changed[distance_transform_edt(~mark) > REACH_MM].any()
    assert not made.moved_mm
    assert made.probability is not None
    assert made.probability.sum(axis=0)[given.labels > 0] == pytest.approx(1.0, abs=1e-5)


def test_probabilities_are_kept_bit_for_bit_beyond_the_reach() -> None:
    image = body()
    found, mark = label_tissues(image, BONE), ball(IN_FAT, 1.5)
    made = correct_labels(image, found.labels, marks=marks(muscle=mark), probability=found.probability)
    far = distance_transform_edt(~mark) > REACH_MM
    assert made.probability is not None
    assert np.array_equal(made.probability[:, far], found.probability[:, far])
    assert np.array_equal(made.labels.labels[far], found.labels.labels[far])
    assert (made.labels.region("muscle").inside)[mark].all()
    assert made.probability[2][mark].min() == 1.0
    agreeing = correct_labels(image, found.labels, marks=marks(fat=mark), probability=found.probability)
    assert np.array_equal(agreeing.probability, found.probability)
    assert agreeing.changed == 0.0


def test_marks_refer_to_labels_by_name_and_add_those_that_are_new() -> None:
    given = spoilt(np.zeros(GRID.shape, dtype=bool))
    inner = ball(IN_FAT, 2.0)
    made = correct_labels(body(), given, marks=marks(bone=ball(ONE, 2.0), FAT=inner))  # the bone is called calcaneus
    assert made.labels.names == given.names
    assert np.array_equal(made.labels.labels, given.labels)
    made = correct_labels(body(), given, marks=marks(vessel=inner, tendon=ball((-22.0, -22.0, -22.0), 5.0)))
    assert made.labels.names == given.names | {5: "vessel"}
    assert made.labels.region("vessel").inside[inner].all()
    assert made.notes == ("The strokes of tendon were not used: they lie outside the label map.",)


def test_what_marks_cannot_correct_is_refused() -> None:
    given, mark = truth(), marks(fat=ball(IN_FAT, 2.0))
    nameless = LabelMap(GRID, given.labels, {number: f"label-{number}" for number in given.names})
    with pytest.raises(InputError, match="The labels have no names, so that strokes of fat cannot be assigned"):
        correct_labels(body(), nameless, marks=mark)
    assert correct_labels(body(), nameless, marks=LabelMap(GRID, mark.labels * 2, {2: "label-2"})).changed == 0.0
    others = certain(spoilt(ball(IN_FAT, 4.0)))
    for wrong in (others, others[:3]):
        with pytest.raises(InputError, match="are not those of the labels"):
            correct_labels(body(), given, marks=mark, probability=wrong)
    with pytest.raises(InputError, match="can be corrected by marks only"):
        correct_labels(body(), given, probability=certain(given))


def test_labels_of_another_subject_are_corrected_and_a_bone_that_is_given_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = truth()
    monkeypatch.setattr(carried, "carry_labels", lambda *_: CarriedLabels(right, certain(right)))
    image, over = body(), ball((-9.5, 0.0, 12.5), 2.0)  # the border of the bone runs through it
    other = Image(GRID, body().values + 1.0)
    both = Mask(GRID, right.labels == 1)
    plain = labels_from(image, other, right, both)
    made = labels_from(image, other, right, both, marks=marks(muscle=ball(IN_FAT, 1.5), fat=over))
    assert made.labels.names == plain.labels.names
    assert made.labels.region("muscle").inside[ball(IN_FAT, 1.5)].all()
    assert not plain.labels.region("muscle").inside[ball(IN_FAT, 1.5)].any()
    assert np.array_equal(made.labels.region("calcaneus").inside, both.inside)
    assert volumes(made)["skin"] == volumes(plain)["skin"]
