"""Time, memory and disk space of a study: they grow with images and meshes, and too little is reported."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from dvc.images.image import Grid, Image, LabelMap
from dvc.io.images.write import write_image, write_labels
from mrstrain.records.progress import duration
from mrstrain.studies import costs
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import Stage, plan
from mrstrain.studies.run import _tell
from tests.mrstrain.studies.checked_study import GRID, MINE, STUDY


def test_larger_images_and_meshes_take_longer_and_more_memory(study):
    (study / "study.toml").write_text(STUDY.replace("[registration]", "[registration]\nborders = false"))
    told = read_study(study)
    by_kind = {stage.kind: stage for stage in plan(told)}
    small, large = 126.0 * 140 * 132, 256.0**3
    registering, simulating = by_kind["register"], by_kind["simulate"]
    assert costs.gib_of(registering, told, small, 0.0) == pytest.approx(
        1.06, abs=0.05
    )  # measured: .95 for 2.1 million, 2.08 for 7.1
    assert costs.gib_of(registering, told, large, 0.0) == pytest.approx(3.5, abs=0.1)
    assert costs.gib_of(registering, told, 384.0**3, 0.0) == pytest.approx(10.6, abs=0.5)
    for count, measured in ((64, 9.6), (128, 15.9), (192, 32.2), (256, 66.3)):
        assert costs.seconds_of(registering, told, count**3, 0.0) == pytest.approx(measured, rel=0.1)
    elastix = STUDY.replace("[registration]", '[registration]\npreset = "heel-mr"')
    for text, measured, needed in ((STUDY, 26.8, 1.42), (elastix, 37.0, 1.61)):  # seconds of elastix: of 2.3 million
        (study / "study.toml").write_text(text)
        usual = read_study(study)
        seconds, gib = (of(registering, usual, 128.0**3, 0.0) for of in (costs.seconds_of, costs.gib_of))
        assert seconds == pytest.approx(measured, rel=0.1)
        assert gib == pytest.approx(needed, rel=0.15)
    assert costs.gib_of(simulating, told, 0.0, 79e3) == pytest.approx(1.2)
    assert costs.gib_of(simulating, told, 0.0, 8 * 79e3) == pytest.approx(8.2)
    assert costs.seconds_of(simulating, told, 0.0, 8 * 79e3) > 8 * costs.seconds_of(simulating, told, 0.0, 79e3)
    (study / "study.toml").write_text(STUDY.replace("[models]", '[models]\nelement = "P2"'))
    exact = read_study(study)
    start = costs.seconds_of(simulating, told, 0.0, 0.0)
    assert costs.seconds_of(simulating, exact, 0.0, 6e4) - start == pytest.approx(
        20.0 * (costs.seconds_of(simulating, told, 0.0, 6e4) - start)
    )
    assert costs.gib_of(simulating, exact, 0.0, 6e4) > 2.0 * costs.gib_of(simulating, told, 0.0, 6e4)
    (study / "study.toml").write_text(STUDY.replace("[models]", "[models]\nlimit_minutes = 0.25"))
    limited = read_study(study)
    (simulating, *_) = (stage for stage in plan(limited) if stage.kind == "simulate")
    assert costs.seconds_of(simulating, limited, 0.0, 2e5) == start + 15.0  # one load, one path
    own, friedman = (stage for stage in plan(told) if stage.kind == "simulate")
    times = []
    for kpa in (0.3, 10.0, 400.0):  # the softer the fat, the longer
        (study / "mine.toml").write_text(MINE.replace("10.0", str(kpa)))
        times.append(costs.seconds_of(own, told, 0.0, 77e3) - start)
    assert times[0] > 3.0 * times[1] > 9.0 * times[2]
    for name in ("friedman", "spears", "luboz", "trebbi", "zwam", "akrami"):  # as recorded
        one = replace(friedman, arguments={**friedman.arguments, "sets": (name,)})
        times.append(costs.seconds_of(one, told, 0.0, 77e3))
    assert times[3:] == sorted(times[3:], reverse=True)


def test_cells_fill_tissues_and_line_their_surfaces(study):
    def cells(edge_mm: float, block: int = 1) -> float:
        text = STUDY.replace("[mesh]", f"[mesh]\nedge_mm = {edge_mm}")
        values = np.kron(np.arange(1, 9).reshape(2, 2, 2) % 2 + 1, np.ones((8,) * 3, dtype=np.int64))
        fine = Grid((16 * block,) * 3, (2.0 / block,) * 3, GRID.origin_mm)
        values = np.kron(values, np.ones((block,) * 3, dtype=np.int64))
        write_labels(study / "tissues.nii.gz", LabelMap(fine, values, {1: "fat", 2: "skin"}))
        (study / "study.toml").write_text(text)
        return costs.sizes_of(read_study(study))[1]

    lining = 0.85 * 16 * 16
    assert cells(2.0) == pytest.approx(32.0**3 / 0.8 + lining)
    assert cells(4.0) == pytest.approx(32.0**3 / 6.4 + lining)
    assert cells(4.0, 2) == pytest.approx(32.0**3 / 6.4 + 4 * lining)  # of smaller voxels


def test_too_little_memory_is_told_with_the_number_of_workers_that_fit(study, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**12, 0, 10**12))
    (study / "study.toml").write_text(STUDY.replace("[registration]", "[registration]\nborders = false"))
    told = read_study(study)
    load = next(stage for stage in plan(told) if stage.kind == "register")
    left = [replace(load, name=f"register {k}") for k in range(4)]

    def care(gib: float, workers: int = 3) -> list[str]:
        monkeypatch.setattr(costs, "usable_memory_bytes", lambda: int(gib * 1024**3))
        return costs.costs(told, left, left, 256.0**3, 0.0, workers)[1]

    assert care(12.0) == []  # three of 3.9 GiB
    assert care(8.0) == ["this machine has 8.0 GiB of memory; run with workers=2 (--workers 2)."]
    assert care(8.0, workers=2) == []
    assert "Crop the images" in care(3.0)[0]


def test_what_a_machine_has_too_little_of_is_said_before_a_run_and_logged(caplog):
    logged = list[str]()
    _tell(["To do: 1 of 1 stages"], ["this machine has 1.0 GiB of memory"], logged.append)
    assert logged == ["To do: 1 of 1 stages", "WARNING: this machine has 1.0 GiB of memory"]
    assert caplog.messages == logged[1:]


def test_time_counts_what_waits_for_what_and_room_each_load_once(study):
    (study / "study.toml").write_text(STUDY)
    told = read_study(study)
    first = next(stage for stage in plan(told) if stage.kind == "register")
    row = [first]
    for k in range(3):
        row.append(replace(first, name=f"register {k}", after=(row[-1].name,)))
    apart = [replace(first, name=f"register {k}") for k in range(4)]
    one = costs.seconds_of(first, told, 1e6, 0.0)

    def time(stages: list[Stage]) -> str:
        return costs.costs(told, stages, stages, 1e6, 0.0, 8)[0][0].split("about ")[1].split(" on")[0]

    assert time(apart) == duration(one)
    assert time(row) == duration(4 * one)
    assert [costs.expected(row, told, 1e6, 0.0)[stage.name].before for stage in row[1:]] == [
        (stage.name,) for stage in row[:-1]
    ]
    levelled = replace(first, name="level trebbi Load1")
    (study / "study.toml").write_text(STUDY + '[loads.Load2]\nimage = "Load1.nii.gz"\n')
    assert costs.disk_bytes(levelled, read_study(study), 1e6) == costs.disk_bytes(levelled, told, 1e6)


def test_a_label_map_that_will_be_made_has_the_cells_of_the_body(study):
    values = np.ones((32,) * 3, dtype=np.float32)
    values[8:24, 8:24, 8:24] = 100.0
    write_image(study / "Load0.nii.gz", Image(Grid(values.shape, (2.0,) * 3, GRID.origin_mm), values))

    def cells(edge_mm: float) -> float:
        text = STUDY.replace("[mesh]", f"[mesh]\nedge_mm = {edge_mm}").replace('names = "tissues.csv"\n', "")
        made = text.replace('labels = "tissues.nii.gz"', 'labels = "auto"\nbone_mask = "bone.nii.gz"')
        (study / "study.toml").write_text(made)
        return costs.sizes_of(read_study(study))[1]

    assert 32.0**3 / 0.8 < cells(2.0) < 2.0 * 32.0**3 / 0.8  # the mask has a voxel more around it
    assert cells(4.0) < 0.3 * cells(2.0)


def test_a_mesh_of_very_many_cells_is_told_with_a_larger_edge_length(study, monkeypatch):
    """A whole heel has 393,000 cells of 2 mm, the default: seven minutes to mesh."""
    monkeypatch.setattr(costs, "usable_memory_bytes", lambda: None)
    (study / "study.toml").write_text(STUDY.replace("[mesh]", "[mesh]\nedge_mm = 2.0"))
    told = read_study(study)
    stages = plan(told)

    def warned(cells: float, left: list[Stage]) -> list[str]:
        return [line for line in costs.costs(told, stages, left, 1e6, cells, 2)[1] if "cells" in line]

    assert warned(2e5, stages) == []
    (line,) = warned(393_265, stages)
    assert line.startswith("the mesh will have about 390,000 cells (edge length 2 mm)")
    assert "give a larger edge_mm under [mesh]" in line
    assert warned(393_265, [stage for stage in stages if stage.kind != "mesh"]) == []
