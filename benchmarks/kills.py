"""Whether a study that is killed again and again at random moments ends with the results of one that never was.

    .venv/bin/python -m benchmarks.kills --work /tmp/kills --out benchmarks/results/kills.json

A small study (that of `benchmarks.long_run`) is run once without a break. Then it is begun from nothing, its whole
process group is killed (SIGKILL) after a time drawn at random, and it is run again, killed again, until it ends; then
it is begun from nothing once more, until so many kills are done. Every second study gets the mesh of the first run as a
file: the mesher gives another mesh each time, so only then its models can be compared. What each study ends with is
compared with the first run, file by file: byte for byte; images, meshes and tables also by their numbers. Results are
written after each kill and each end.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import psutil

from benchmarks.long_run import study_in
from dvc import read_image
from mrstrain.records.provenance import versions
from tests.processes import under_way

MESHED = '[mesh]\nedge_mm = 9.0\nlabels = "to_mesh.nii.gz"\nnames = "to_mesh.csv"\n'
GIVEN = '[mesh]\nfile = "mesh.vtu"\n'
RECORDS = (".json", ".html", ".log", ".pdf", ".txt", ".npz", ".h5", ".lock")
"""Files with times of day, seconds taken, or the order of work in them: only whether they are there is compared."""


def started(study: Path) -> subprocess.Popen[bytes]:
    """`mrstrain run` in a session of its own, which can be killed as a whole."""
    command = [sys.executable, "-m", "mrstrain", "run", str(study), "--workers", "2", "--no-open"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)


def left_of(session: int) -> list[int]:
    """The processes of a session that are still there."""
    there = []
    for one in psutil.process_iter():
        try:
            if os.getsid(one.pid) == session and one.status() != psutil.STATUS_ZOMBIE:
                there.append(one.pid)
        except (OSError, psutil.Error):
            continue
    return there


def killed(study: Path, after_s: float) -> dict[str, Any] | None:
    """Run a study and kill it after a time; what was under way then, or None if it had ended before."""
    process = started(study)
    try:
        _, told = process.communicate(timeout=after_s)
    except subprocess.TimeoutExpired:
        records = study / "results" / ".study"
        busy = [lock.stem for lock in sorted(records.glob("?*.lock")) if under_way(records, lock.stem)]
        done = len(list(records.glob("*.json")))
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        time.sleep(3.0)  # processes in groups of their own end by themselves when their parent is gone
        return {"after_s": round(after_s, 2), "under_way": busy, "done": done, "left": len(left_of(process.pid))}
    if process.returncode != 0:
        raise SystemExit(f"The study failed: {told.decode()}")
    return None


def numbers_of(file: Path) -> np.ndarray | None:
    """All numbers of an image, a mesh or a table, in their order; None for other files."""
    if file.name.endswith(".nii.gz"):
        return np.asarray(read_image(file, allow_missing=True).values) if "displacement" not in file.name else None
    if file.suffix == ".vtu":
        mesh = meshio.read(file)
        arrays = [mesh.points, *mesh.point_data.values(), *(block for of in mesh.cell_data.values() for block in of)]
        return np.concatenate([np.asarray(array, dtype=np.float64).ravel() for array in arrays])
    if file.suffix == ".csv":
        with file.open(newline="") as table:
            cells = [cell for row in csv.reader(table) for cell in row]
        return np.array([number(cell) for cell in cells])
    return None


def number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def compared(study: Path, whole: Path) -> dict[str, Any]:
    """Files of two studies: those that are equal byte for byte by their kind, and how far the others differ."""
    told: dict[str, Any] = {"missing": [], "more": [], "equal": Counter(), "differ": {}}
    ours, theirs = (
        {str(file.relative_to(place)) for file in place.rglob("*") if file.is_file() and ".study" not in file.parts}
        for place in (study / "results", whole / "results")
    )
    told["missing"], told["more"] = sorted(theirs - ours), sorted(ours - theirs)
    for name in sorted(ours & theirs):
        one, other = study / "results" / name, whole / "results" / name
        if one.suffix in RECORDS:
            continue
        if one.read_bytes() == other.read_bytes():
            told["equal"][f"{name.split('/')[0]}/*{''.join(one.suffixes[-2:])}"] += 1
            continue
        a, b = numbers_of(one), numbers_of(other)
        if a is None or b is None or a.shape != b.shape:
            told["differ"][name] = "other bytes" if a is None else "other shape"
        else:
            told["differ"][name] = float(np.nanmax(np.abs(a - b)) / max(np.nanmax(np.abs(b)), 1e-300))
    return told


def anew(work: Path, study: Path, mesh: Path | None) -> None:
    """The files of the study and nothing else; with a mesh, it is not meshed."""
    shutil.rmtree(study, ignore_errors=True)
    shutil.copytree(work / "images", study)
    if mesh is not None:
        for file in (mesh, mesh.with_suffix(".json")):  # with the names of its regions and surfaces
            shutil.copy(file, study / file.name)
        text = (study / "study.toml").read_text()
        assert MESHED in text
        (study / "study.toml").write_text(text.replace(MESHED, GIVEN))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--longest", type=float, help="s until a kill at most; by default 0.7 of a run without a break")
    parser.add_argument("--work", type=Path, required=True, help="made, and filled; must not exist")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    study_in(given.work / "images")
    whole, mesh = {}, None
    for kind in ("meshed", "given"):
        anew(given.work, whole.setdefault(kind, given.work / f"whole-{kind}"), mesh)
        began = time.monotonic()
        assert killed(whole[kind], 7200.0) is None
        unbroken_s = time.monotonic() - began
        mesh = whole["meshed"] / "results" / "mesh" / "mesh.vtu"
    longest_s = given.longest or 0.7 * unbroken_s
    random, study = np.random.default_rng(given.seed), given.work / "study"
    kills: list[dict[str, Any]] = []
    ends: list[dict[str, Any]] = []

    def write() -> None:
        told = {
            "versions": versions(),
            "seed": given.seed,
            "longest_s": longest_s,
            "unbroken_s": round(unbroken_s, 1),
            "kills": kills,
        }
        given.out.write_text(json.dumps(told | {"ends": ends}, indent=1) + "\n")

    while len(kills) < given.kills:
        kind = ("given", "meshed")[len(ends) % 2]
        anew(given.work, study, mesh if kind == "given" else None)
        of_this = 0
        while True:
            enough = len(kills) >= given.kills
            kill = killed(study, 7200.0 if enough else random.uniform(0.0, longest_s))
            if kill is None:
                break
            of_this += 1
            kills.append({"study": len(ends) + 1, **kill})
            print(kills[-1], flush=True)
            write()
        ends.append({"mesh": kind, "kills": of_this, **compared(study, whole[kind])})
        print(ends[-1], flush=True)
        write()


if __name__ == "__main__":
    main()
