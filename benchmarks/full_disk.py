"""Whether a study ends well whose disk is full at each of its stages, and goes on afterwards.

    sudo mount -t tmpfs -o size=400M tmpfs DISK
    sudo .venv/bin/python -m benchmarks.full_disk --disk DISK --work DIR --out benchmarks/results/full_disk.json

The study is that of `benchmarks.kills`, on a small file system of its own. As soon as its next stage is under way, the
disk is filled. When the run has ended, the disk gets its room back, and the study is run again, until this has been
done at each stage. What the study ends with is compared with a run on a disk with room, as `benchmarks.kills` does it.
Told are the exit status, whether the cause was named, tracebacks, and the processes and empty files that were left.
"""

from __future__ import annotations

import argparse
import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.kills import anew, compared, left_of, started
from benchmarks.long_run import study_in
from mrstrain.records.provenance import versions
from tests.processes import under_way


def fill(filler: Path) -> None:
    """Write a file until its disk is full."""
    with suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 16))


def finished(study: Path) -> None:
    """Run a study to its end."""
    process = started(study)
    _, said = process.communicate(timeout=3600.0)
    assert process.returncode == 0, said.decode()


def filled(study: Path, filler: Path, seen: set[str]) -> dict[str, Any] | None:
    """Run a study whose disk is filled when a stage begins that is not among those seen; None if none did."""
    records = study / "results" / ".study"
    process, stage = started(study), ""
    while process.poll() is None and not stage:
        busy = {lock.stem for lock in records.glob("?*.lock") if under_way(records, lock.stem)}
        stage = next(iter(sorted(busy - seen)), "")
        time.sleep(0.05)
    if stage:
        seen.add(stage)
        fill(filler)
    began = time.monotonic()
    _, said = process.communicate(timeout=3600.0)
    if not stage:
        assert process.returncode == 0, said.decode()
        return None
    ended_s = time.monotonic() - began
    files = [file for file in study.rglob("*") if file.is_file() and file.suffix != ".lock"]
    empty = sorted(str(file.relative_to(study)) for file in files if not file.stat().st_size)
    filler.unlink()
    told = said.decode(errors="replace")
    return {
        "stage": stage, "exit": process.returncode, "ended_after_s": round(ended_s, 1),
        "cause_named": "No space left on device" in told, "traceback": "Traceback" in told,
        "processes_left": len(left_of(process.pid)), "empty_files": empty,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--disk", type=Path, required=True, help="a small file system, empty, such as a tmpfs")
    parser.add_argument("--work", type=Path, required=True, help="on another disk; made, and must not exist")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    study_in(given.work / "images")
    anew(given.work, meshed := given.work / "meshed", None)
    whole, study = given.work / "whole", given.disk / "study"
    finished(meshed)
    mesh = meshed / "results" / "mesh" / "mesh.vtu"
    anew(given.work, whole, mesh)
    finished(whole)
    anew(given.work, study, mesh)
    seen, runs = set[str](), list[dict[str, Any]]()
    while (run := filled(study, given.disk / "filler", seen)) is not None:
        runs.append(run)
        print(run, flush=True)
    end = compared(study, whole)
    print(end, flush=True)
    given.out.write_text(json.dumps({"versions": versions(), "runs": runs, "end": end}, indent=1) + "\n")


if __name__ == "__main__":
    main()
