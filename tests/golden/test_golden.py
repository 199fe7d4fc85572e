"""The program gives the figures that it gave: every scene against its record; and the check sees what it should.

Written anew with ``python -m tests.golden --write``; see there.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.golden.reading import quantities
from tests.golden.record import check, differences, figures_of, made_with, read_record
from tests.golden.scenes import SCENES


@pytest.mark.parametrize(
    "scene",
    [pytest.param(name, marks=pytest.mark.full_size) if name in ("study", "elastix") else name for name in SCENES],
)
@pytest.mark.usefixtures("in_this_process")
def test_the_record_holds(scene: str, tmp_path: Path) -> None:
    wrong, words = check(scene, quantities(SCENES[scene](tmp_path, 1)))
    print(words)
    assert not wrong, "\n".join([words, *wrong])


def test_every_record_is_made_with_the_same() -> None:
    made = [read_record(scene)[0] for scene in SCENES]
    assert all(one == made[0] for one in made)
    assert set(made[0]) == set(made_with())


STRAIN = np.random.default_rng(1).gamma(2.0, 0.05, (12, 11, 10)).astype(np.float32)
STRAIN[0] = np.nan


@pytest.mark.parametrize(
    "broken",
    [
        STRAIN * np.float32(1.0 + 1e-5),
        STRAIN + np.float32(2e-7),
        STRAIN[:, ::-1],
        np.where(np.arange(STRAIN.size).reshape(STRAIN.shape) == 700, np.nan, STRAIN),
        np.nan_to_num(STRAIN),
        STRAIN[..., :-1],
    ],
    ids=["a part in 1e5 more", "shifted", "mirrored", "one voxel less", "missing as zero", "cropped"],
)
def test_figures_alone_show_what_is_broken(broken: np.ndarray) -> None:
    kept = {"max_shear": figures_of(STRAIN)}
    assert differences(kept, {"max_shear": STRAIN}, bits=True) == []
    assert len(differences(kept, {"max_shear": broken}, bits=False)) == 1


def test_round_off_changes_bits_and_no_figures() -> None:
    kept = {"max_shear": figures_of(STRAIN)}
    other = STRAIN * (1.0 + 3e-8 * np.random.default_rng(2).standard_normal(STRAIN.shape)).astype(np.float32)
    assert differences(kept, {"max_shear": other}, bits=False) == []
    (told,) = differences(kept, {"max_shear": other}, bits=True)
    assert "its bits do not" in told


def test_numbers_and_words_and_what_is_there_count() -> None:
    found = {"travel": np.array([4.0, 1.0, 0.0]), "level": np.array("trust"), "model": np.array(["a", "b"])}
    kept = {name: figures_of(quantity) for name, quantity in found.items()}
    assert differences(kept, found, bits=True) == []
    for name, broken in (
        ("travel", np.array([4.00001, 1.0, 0.0])), ("travel", np.array([4.0, 1.0])), ("level", np.array("caution")),
        ("model", np.array(["b", "a"])),
    ):  # fmt: skip
        assert len(differences(kept, found | {name: broken}, bits=False)) == 1, name
    assert differences(kept, {"travel": found["travel"]}, bits=False) == ["level: is no more", "model: is no more"]
    assert differences({}, {"level": found["level"]}, bits=False) == ["level: is not in the record"]
