"""Whether a run that goes on for long holds ever more of the machine: memory, files, threads, temporary files.

    .venv/bin/python -m benchmarks.long_run --work /tmp/long --out benchmarks/results/long_run.json

The stages of a small study (a heel at 2.3 mm, a mesh of 9 mm; with --pad the smaller pad of the golden record) run one
after another in the Dask worker that a study runs in: so many registrations, then so many simulations. Told after every
ten, between two stages, is what the process tree holds: resident memory, and the part of it that is not of files; open
files, threads, files in the kernel's shared memory that carry the number of one of its processes, and files in its
folder for temporary files (Linux only). Told at the end is what is open then and was not after the first ten, by its
kind. Results are written after every ten.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from dvc import Image, write_image, write_labels
from mrstrain.records.provenance import versions
from mrstrain.studies.cluster import StageRunner, cluster
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import Stage, plan
from phantoms import heel_pair
from tests.golden.scenes import GIVEN
from tests.mrstrain.studies.conftest import STUDY, coarse

EVERY = 10
SHARED = Path("/dev/shm")


def study_in(folder: Path) -> dict[str, Stage]:
    """Write the images of a small study and its file; its stages by kind, with the arguments of one of each."""
    folder.mkdir(parents=True)
    pair = heel_pair(3, load=0.6, shape=(44, 50, 46), spacing_mm=2.3)
    fine = heel_pair(3, load=0.6, shape=(64, 72, 68), spacing_mm=1.6)
    values = pair.repeat.values.copy()
    values[0, 0, 0] += 1.0  # no image is given twice
    other = Image(pair.repeat.grid, values)
    for name, image in (("Load0", pair.reference), ("Load1", pair.loaded), ("Load2", other)):
        write_image(folder / f"{name}.nii.gz", image)
    write_image(folder / "Load0-again.nii.gz", pair.repeat)
    write_labels(folder / "tissues.nii.gz", pair.labels)
    write_labels(folder / "to_mesh.nii.gz", coarse(fine.labels))
    (folder / "study.toml").write_text(STUDY)
    return {stage.kind: stage for stage in plan(read_study(folder))}


def pad_in(folder: Path) -> dict[str, Stage]:
    """Write the study of the golden record; its stages by kind."""
    shutil.copytree(GIVEN, folder)
    return {stage.kind: stage for stage in plan(read_study(folder))}


def opened() -> Counter[str]:
    """What this process and all below it have open, by kind: pipes, sockets, and files by their path."""
    kinds = Counter[str]()
    for one in (psutil.Process(), *psutil.Process().children(recursive=True)):
        for link in Path(f"/proc/{one.pid}/fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                kinds[re.sub(r"\d+", "N", os.readlink(link))] += 1
    return kinds


def anonymous_kib(pid: int) -> int:
    """Resident memory of a process that is not that of files, such as libraries, whose pages the system takes back."""
    (kib,) = re.findall(r"^RssAnon:\s+(\d+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    return int(kib)


def held() -> dict[str, float]:
    """What this process and all below it hold."""
    tree = [psutil.Process(), *psutil.Process().children(recursive=True)]
    numbers = {str(one.pid) for one in tree}
    return {
        "processes": len(tree),
        "resident_mib": round(sum(one.memory_info().rss for one in tree) / 2**20, 1),
        "anonymous_mib": round(sum(anonymous_kib(one.pid) for one in tree) / 2**10, 1),
        "open_files": sum(one.num_fds() for one in tree),
        "threads": sum(one.num_threads() for one in tree),
        "shared_memory_files": sum(not numbers.isdisjoint(re.findall(r"\d+", one.name)) for one in SHARED.iterdir()),
        "temporary_files": sum(1 for _ in Path(tempfile.gettempdir()).rglob("*")),
    }


def repeated(runner: StageRunner, stage: Stage, count: int, keep: Callable[[dict[str, Any]], None]) -> None:
    """Run a stage so many times, from nothing each time; what is held after every ten is kept at once."""
    arguments: Mapping[str, Any] = {**stage.arguments, **dict.fromkeys(stage.perhaps, ())}
    seen, began, first = list[dict[str, float]](), time.monotonic(), Counter[str]()
    for number in range(1, count + 1):
        for place in stage.gives:
            shutil.rmtree(place, ignore_errors=True)
            place.parent.mkdir(parents=True, exist_ok=True)
        runner.begin(f"{stage.name} {number}", stage.kind, arguments, stage.gives[0].parent / "lock")
        _, outcome, _ = runner.next()
        if isinstance(outcome, str):
            raise SystemExit(f"{stage.name} failed: {outcome}")
        if number % EVERY == 0:
            seen.append({"after": number, **held()})
            first = first or opened()
            print(stage.kind, seen[-1], flush=True)
            grown = {name: round(seen[-1][name] / max(held, 1) - 1.0, 4) for name, held in seen[0].items()}
            del grown["after"]
            keep(
                {
                    "count": number,
                    "seconds": round(time.monotonic() - began, 1),
                    "held": seen,
                    "grown_since_first_ten": grown,
                    "opened_since_first_ten": opened() - first,
                }
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--registrations", type=int, default=200)
    parser.add_argument("--simulations", type=int, default=100)
    parser.add_argument("--pad", action="store_true", help="of 30 x 30 x 26 voxels: less time")
    parser.add_argument("--work", type=Path, required=True, help="made, and filled; must not exist")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    stages = (pad_in if given.pad else study_in)(given.work)
    temporary = given.work / "temporary"
    temporary.mkdir()
    os.environ["TMPDIR"] = tempfile.tempdir = str(temporary)
    with cluster(lambda *_: None, [given.work], workers=1) as runner:
        runs: dict[str, Any] = {}

        def kept(kind: str, run: dict[str, Any]) -> None:
            runs[kind] = run
            asked = {"registrations": given.registrations, "simulations": given.simulations, "pad": given.pad}
            given.out.write_text(json.dumps({"asked": asked, "versions": versions(), "runs": runs}, indent=1) + "\n")

        for kind, count in (("mesh", 1), ("register", given.registrations), ("simulate", given.simulations)):
            if kind in stages:  # the pad has a mesh
                repeated(runner, stages[kind], count, partial(kept, kind))


if __name__ == "__main__":
    main()
