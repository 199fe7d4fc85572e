"""A small study that `check` looks at: the fixture `study` is a folder of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvc.images.image import Grid, Image, LabelMap
from dvc.io.images.write import write_image, write_labels
from mrstrain.studies.check import check

GRID = Grid((16, 16, 16), (2.0, 2.0, 2.0), (-6.0, -6.0, -6.0))  # around the dome
STUDY = """
[study]
name = "Heel"
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
names = "tissues.csv"
[loads.Load1]
image = "Load1.nii.gz"
normal_n = 15.0
shear_n = 4.0
[plate]
normal = [-1.0, 0.0, 0.0]
[registration]
[mesh]
[models]
sets = ["mine.toml", "friedman"]
"""
MINE = '[mine]\n[mine.fat]\nlaw = "neo-Hooke"\nmu_kpa = 10.0\nnu = 0.49\n'


def written(folder: Path) -> Path:
    """Two images of noise, a label map of bone, fat and tendon, and a set that has a law for fat alone."""
    rng = np.random.default_rng(1)
    for name in ("Load0", "Load1"):
        write_image(folder / f"{name}.nii.gz", Image(GRID, rng.uniform(0.0, 100.0, GRID.shape)))
    values = np.ones(GRID.shape, dtype=np.int64)
    values[:4], values[4:6] = 2, 3
    write_labels(folder / "tissues.nii.gz", LabelMap(GRID, values, {1: "fat", 2: "bone", 3: "tendon", 9: "skin"}))
    (folder / "mine.toml").write_text(MINE)
    (folder / "study.toml").write_text(STUDY)
    return folder


def wrong(folder: Path, *changes: tuple[str, str]) -> str:
    text = STUDY
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "study.toml").write_text(text)
    return "\n".join(check(folder).wrong)
