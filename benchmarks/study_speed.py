"""Time and memory of a whole study: the demonstration from nothing, again with nothing changed, and its report alone.

    .venv/bin/python -m benchmarks.study_speed --work /tmp/demo --out benchmarks/results/study_speed.json
    .venv/bin/python -m benchmarks.study_speed --work /tmp/full --full --study benchmarks/full_six_sets.toml \
        --out benchmarks/results/study_speed_full.json

The work folder has to be empty. With ``--study`` the phantom is made first, and this study file is used. The commands
are those of another source tree if ``--tree`` is given. Seconds are wall and processor time of the command and its
children, memory that of all of them together, shared pages counted by their share.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.memory import peak_kib
from mrstrain.records.provenance import versions

HERE = Path(__file__).resolve().parents[1]


def timed(tree: Path, *arguments: str) -> dict[str, float]:
    """Wall and processor seconds and peak memory (GiB) of one command of mrstrain in a source tree."""
    environment = os.environ | {"PYTHONPATH": str(tree)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed copy holds the bytecode of its modules
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    # in the tree: the folder in which Python starts comes before PYTHONPATH
    process = subprocess.Popen([sys.executable, "-m", "mrstrain", *arguments], env=environment, cwd=tree)
    peak = peak_kib(process)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "exit": process.returncode,
        "wall_s": time.perf_counter() - began,
        "cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "peak_gib": peak / 2**20,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--full", action="store_true", help="the published size")
    parser.add_argument("--study", type=Path, help="a study file in the place of the demonstration's")
    parser.add_argument("--tree", type=Path, default=HERE, help="source tree of the commands")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    tree = given.tree.resolve()
    if given.work.exists() and any(given.work.iterdir()):
        parser.error(f"{given.work} is not empty: the first run has to begin from nothing")
    work = given.work.resolve()
    demo = ["demo", "--out", str(work), *(["--full"] if given.full else [])]
    runs = {}
    if given.study:
        runs["phantom"] = timed(tree, "phantom", "--seed", "1", "--out", str(work))
        (work / "study.toml").write_text(given.study.read_text(encoding="utf-8"), encoding="utf-8")
    runs["from images" if given.study else "from nothing"] = timed(tree, *demo)
    runs["again"] = timed(tree, *demo)
    runs["report alone"] = timed(tree, "run", str(work), "--report-only")
    results = {"versions": versions(), "cores": len(os.sched_getaffinity(0)), "full": given.full, "runs": runs}
    given.out.write_text(json.dumps(results, indent=1) + "\n")
    for name, told in runs.items():
        print(name, {key: round(value, 2) for key, value in told.items()})


if __name__ == "__main__":
    main()
