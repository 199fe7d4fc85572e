"""Another subject's labels, carried over: the affine start, the combination with the image, and a heel as a whole."""

import numpy as np
import pytest

from dvc import Affine, Composed, Grid, Image, LabelMap, Mask, RigidMotion, TissueLabels, labels_from, tissue_mask
from dvc.errors import InputError, RegistrationError
from dvc.images.resample import carry
from dvc.labelling.carried import CarriedLabels, _groups, _sampled, _weighed
from dvc.registration.affine_fit import affine_fit, parts_of
from phantoms import Heel, heel_grid, labels_of, random_foot_motion, scan
from tests.dvc.labelling.test_tissues import dice

STRETCH = np.array([[1.06, 0.04, 0.0], [-0.05, 0.95, 0.03], [0.02, 0.0, 1.03]])


@pytest.fixture(scope="module")
def heels() -> tuple[Image, LabelMap, Image, LabelMap]:
    """A heel, and a larger one with thinner pad and skin that lies otherwise."""
    grid, theirs, mine = heel_grid(2.0), Heel(1), Heel(7, size=1.08, pad_mm=14.0)
    foot, own = random_foot_motion(1, 5), heel_grid(2.0, 1.08)
    moved = grid.moved_by(foot.rotation, foot.translation_mm)
    other = Image(moved, scan(theirs, grid, snr=25.0, number=0).values)
    labels = LabelMap(moved, labels_of(theirs, grid).labels, labels_of(theirs, grid).names)
    return scan(mine, own, snr=25.0, number=0), labels_of(mine, own), other, labels


def test_an_affine_map_is_recovered(heels: tuple[Image, LabelMap, Image, LabelMap]) -> None:
    image, truth, _, _ = heels
    shift = np.array([3.0, -2.0, 1.0])
    wanted = Affine(STRETCH, shift)  # from the image to the other one
    back = Affine(np.linalg.inv(STRETCH), -np.linalg.inv(STRETCH) @ shift)
    other = Image(image.grid, np.nan_to_num(carry(image, image.grid, back, order=1)))
    body = Mask(image.grid, truth.labels > 0)
    found = affine_fit(image, other, body, tissue_mask(other))
    points = body.points()[::50]
    off = np.linalg.norm(found.displacement(points) - wanted.displacement(points), axis=1)
    begun = wanted.displacement(points) - wanted.displacement(points).mean(axis=0)  # where centroids lie on each other
    assert np.sqrt(np.mean(off**2)) < 1.2
    assert np.sqrt(np.mean(np.sum(begun**2, axis=1))) > 2.0


def test_an_affine_map_is_a_stretch_and_then_a_rigid_motion() -> None:
    grid = Grid((6, 7, 8), (1.0, 2.0, 1.0), (10.0, -5.0, 3.0))
    body, whole = Mask(grid, np.ones(grid.shape, dtype=bool)), Affine(STRETCH, np.array([3.0, -2.0, 1.0]))
    rigid, stretch = parts_of(whole, body)
    points = body.points()
    assert np.allclose(Composed([stretch, rigid]).displacement(points), whole.displacement(points))
    assert np.allclose(rigid.rotation @ rigid.rotation.T, np.eye(3))
    assert np.allclose(stretch.displacement(points.mean(axis=0)[None]), 0.0)
    assert np.allclose(stretch.matrix, stretch.matrix.T)


def test_labels_are_those_at_the_place_where_a_deformation_leads() -> None:
    grid = Grid((20, 6, 6), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    values = np.where(np.arange(20) < 8, 1, np.where(np.arange(20) < 18, 4, 0))[:, None, None] * np.ones((1, 6, 6), int)
    labels = LabelMap(grid, values, {1: "fat", 4: "muscle", 9: "nothing"})
    shift, body = RigidMotion(np.eye(3), np.array([3.0, 0.0, 0.0])), np.zeros(grid.shape, dtype=bool)
    body[:15] = True
    made = _sampled(labels, shift, grid, Mask(grid, body))
    assert made.labels.names == {1: "fat", 4: "muscle"}
    assert made.labels.labels[:, 2, 2].tolist() == [1] * 5 + [4] * 10 + [0] * 5
    chance = made.probability[0][:, 2, 2]
    assert np.all(np.diff(chance[:15]) <= 1e-6)  # the further from fat's border, the less
    assert chance[0] > 0.99
    assert chance[4] == pytest.approx(0.69, abs=0.05)  # half a voxel inside, of a border that is off by 1 mm
    body[:] = True
    with pytest.raises(RegistrationError, match="cover 75 % of the body"):
        _sampled(labels, shift, grid, Mask(grid, body))


def test_image_and_carried_labels_are_weighed() -> None:
    grid = Grid((5, 1, 1), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    seen = np.array([[1, 0, 0, 0, 0], [0, 0.9, 0.1, 0, 0], [0, 0.1, 0.9, 1, 0]], dtype=np.float32).reshape(3, 5, 1, 1)
    found = TissueLabels(
        LabelMap(grid, np.array([1, 2, 3, 3, 0]).reshape(5, 1, 1), {1: "bone", 2: "fat", 3: "muscle"}),
        seen,
        ("a note",),
    )
    carried = np.array(
        [[0, 0, 0, 0, 0], [0.8, 0.4, 0.4, 0.97, 0], [0.2, 0.4, 0.4, 0, 0], [0, 0.2, 0.2, 0.03, 0]], dtype=np.float32
    ).reshape(4, 5, 1, 1)
    names = {3: "Calcaneus", 1: "fat", 7: "muscle", 8: "tendon"}
    over = CarriedLabels(LabelMap(grid, np.array([1, 1, 7, 1, 0]).reshape(5, 1, 1), names), carried)
    made = _weighed(found, over, {"bone": [3], "fat": [1], "muscle": [7, 8]})
    # the bone is known; fat and muscle as the image shows them; where it is overruled, the prior is nearly certain
    assert made.labels.labels.ravel().tolist() == [3, 1, 7, 1, 0]
    assert made.probability[:, 1, 0, 0].tolist() == pytest.approx(
        [0.0, 0.36 / 0.48, 0.08 / 0.48, 0.04 / 0.48], abs=1e-4
    )
    assert made.probability.sum(axis=0).ravel().tolist() == pytest.approx([1, 1, 1, 1, 0])
    assert made.notes == ("a note",)


def test_a_tissue_of_its_own_name_belongs_to_fat_or_muscle_by_its_brightness() -> None:
    grid = Grid((7, 5, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    numbers = np.arange(7)[:, None, None] * np.ones((1, 5, 5), int)
    level = np.array([0.0, 700.0, 650.0, 300.0, 100.0, 640.0, 690.0])[:, None, None] * np.ones((1, 5, 5))
    names = {1: "bone", 2: "fat", 3: "muscle", 4: "tendon", 5: "pad", 6: "talus"}
    other, labels = Image(grid, level), LabelMap(grid, numbers, names)
    for here, wanted in (
        ("other bone", {"bone": [1], "fat": [2, 5], "muscle": [3, 4], "other bone": [6]}),
        ("skin", {"bone": [1], "fat": [2, 5, 6], "muscle": [3, 4]}),
    ):
        found = LabelMap(grid, np.clip(numbers, 1, 4), {1: "bone", 2: "fat", 3: "muscle", 4: here})
        assert _groups(TissueLabels(found, np.zeros((4, *grid.shape))), other, labels, "bone") == wanted


@pytest.mark.full_size
def test_labels_of_another_heel_find_their_places(heels: tuple[Image, LabelMap, Image, LabelMap]) -> None:
    image, truth, other, labels = heels
    told: list[float] = []
    made = labels_from(image, other, labels, watch=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert made.labels.names == truth.names  # numbers too
    shares = {name: dice(made.labels.labels == number, truth.labels == number) for number, name in truth.names.items()}
    for name, least in {"bone": 0.95, "fat": 0.92, "muscle": 0.9, "skin": 0.75, "tendon": 0.5, "ankle": 0.8}.items():
        assert shares[name] > least, shares
    body = made.labels.labels > 0
    assert np.allclose(made.probability.sum(axis=0)[body], 1.0, atol=1e-3)
    assert 0.02 < made.uncertain < 0.4
    nameless = LabelMap(labels.grid, labels.labels, {n: f"label-{n}" for n in labels.names})
    with pytest.raises(InputError, match="named like a bone"):
        labels_from(image, other, nameless)
