"""Memory of the workers over a cohort of small subjects: it must not grow with their number.

    .venv/bin/python -m benchmarks.cohort_memory --work /tmp/cohort --out benchmarks/results/cohort_memory.json

Each subject is a heel at 1.6 mm with one load, registered with few iterations. Twice a second the resident memory of
every process below this one is read: that of the Dask workers themselves (the processes that live through the whole
cohort), and of all.
"""

from __future__ import annotations

import argparse
import json
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import psutil

from dvc import write_image, write_labels
from mrstrain.records.provenance import versions
from mrstrain.studies.file import read_study
from mrstrain.studies.run import run_studies
from phantoms import heel_pair
from tests.quick import QUICK

STUDY = """[study]
name = "Subject {number:02d}"
seed = {seed}
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
names = "tissues.csv"
[loads.Load1]
image = "Load1.nii.gz"
[registration]
parameters = ["quick.txt"]
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=50)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    places = [subject(given.work / f"subject-{n:02d}", n) for n in range(1, given.subjects + 1)]
    seen: list[tuple[float, list[float], float]] = []
    over = threading.Event()
    watching = threading.Thread(target=watch, args=(seen, over))
    watching.start()
    began = time.monotonic()
    try:
        ran = run_studies([read_study(place) for place in places])
    finally:
        over.set()
        watching.join()
    seconds = time.monotonic() - began
    workers = np.array([sum(w) / max(len(w), 1) for _, w, _ in seen if w])
    tenth = max(len(workers) // 10, 1)
    found = {
        "subjects": given.subjects,
        "complete": sum(one.complete for one in ran),
        "seconds": seconds,
        "worker_mib_first_tenth": float(np.median(workers[tenth : 2 * tenth])),
        "worker_mib_last_tenth": float(np.median(workers[-tenth:])),
        "worker_mib_most": float(max(max(w) for _, w, _ in seen if w)),
        "all_mib_most": float(max(total for *_, total in seen)),
    }
    given.out.write_text(json.dumps({"versions": versions()} | found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


def subject(place: Path, number: int) -> Path:
    """A study of one load; its images are those of a few heels, each time with other noise."""
    if not (place / "study.toml").is_file():
        place.mkdir(parents=True, exist_ok=True)
        pair = heel_pair(seed=number, shape=(64, 72, 68), spacing_mm=1.6, load=0.6)
        write_image(place / "Load0.nii.gz", pair.reference)
        write_image(place / "Load1.nii.gz", pair.loaded)
        write_labels(place / "tissues.nii.gz", pair.labels)
        (place / "quick.txt").write_text(QUICK)
        (place / "study.toml").write_text(STUDY.format(number=number, seed=number))
    shutil.rmtree(place / "results", ignore_errors=True)
    return place


def watch(seen: list[tuple[float, list[float], float]], over: threading.Event) -> None:
    """Resident memory, MiB: of the workers (children that a nanny started), and of all processes together."""
    own = psutil.Process()
    while not over.wait(0.5):
        workers, total = [], 0.0
        for process in own.children(recursive=True):
            try:
                held = process.memory_info().rss / 2**20
                command = " ".join(process.cmdline())
            except psutil.Error:
                continue
            total += held
            if "spawn_main" in command and held > 50.0:
                workers.append(held)
        seen.append((time.monotonic(), workers, total))


if __name__ == "__main__":
    main()
