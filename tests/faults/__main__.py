"""Does the test suite notice? Faults of the kind that really happen, seeded one at a time.

    python -m tests.faults                               every fault of faults.toml, against the tests of `make test`
    python -m tests.faults --only load-order-reversed    one of them
    python -m tests.faults --suite all --own             against those of `make test-all` that each fault names

For each fault the sources are copied, its text is replaced in the copy, and pytest runs there: first the tests that the
fault names, then, if they pass, the suite. What failed is run once more without the fault, since a test that fails
anyway notices nothing. Results are written after each fault, by default beside the list; those of faults not run now
stay as they are. Exit status 1 if a fault was missed, or could not be tried.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PYTEST = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
PYTEST += ["--ignore", "tests/faults"]  # which sees every fault
SUITES = {"short": ["-m", "not full_size"], "all": []}
"""What pytest gets beside for the tests of `make test`, and for those of `make test-all`."""

_LEFT_OUT = shutil.ignore_patterns(".*", "site", "demo", "out", "build", "dist", "*.egg-info")
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+?\.(?:py|md)(?:::.+?)?)(?: - (.*))?$", re.MULTILINE)
_INTERRUPTED, _NOT_FOUND, _NONE_SELECTED = 2, 4, 5  # pytest's exit status


class NotTriedError(Exception):
    """A fault that tells nothing as it stands."""


class Trial:
    """Copies of the sources, with a fault or without, and pytest in them."""

    def __init__(self, folder: Path, suite: list[str], limit_s: float, own: bool) -> None:
        self._folder, self._suite, self._limit_s, self._own = folder, suite, limit_s, own
        self._whole, self._alone = folder / "whole", Lock()  # copied by one, or tested in by one, at a time
        shutil.copytree(ROOT, self._whole, ignore=_LEFT_OUT)
        self._passes = cache(lambda test: self._failed(self._whole, [test]) is None)

    def run(self, fault: dict[str, Any]) -> dict[str, object]:
        """Seed one fault: what noticed it, and after how long."""
        began = time.monotonic()
        try:
            by, why = self._noticed(fault) or ("", "")
            told = {"outcome": "caught" if by else "missed", "by": by, "why": why}
        except NotTriedError as wrong:
            told = {"outcome": "not tried", "by": "", "why": str(wrong)}
        return {"breaks": fault["breaks"], **told, "seconds": round(time.monotonic() - began, 1)}

    def _noticed(self, fault: dict[str, Any]) -> tuple[str, str] | None:
        copy = self._folder / fault["name"]
        with self._alone:
            shutil.copytree(self._whole, copy)
        try:
            seed(copy, fault)
            failed = self._failed(copy, fault["tests"])
            if failed is None and not self._own:
                failed = self._failed(copy, [])
        finally:
            shutil.rmtree(copy, ignore_errors=True)
        with self._alone:
            if failed is not None and not self._passes(failed[0]):
                raise NotTriedError(f"{failed[0]} fails without the fault, too ({failed[1]})")
        return failed

    def _failed(self, copy: Path, tests: list[str]) -> tuple[str, str] | None:
        """Of tests run in a copy, the first that failed, and how; None if all passed."""
        status, said = self._pytest(copy, tests)
        if status == _NOT_FOUND and any("::" in test for test in tests):  # renamed within its file
            status, said = self._pytest(copy, [test.split("::")[0] for test in tests])
        if status in (0, _NONE_SELECTED):
            return None
        found = _FAILED.search(said)
        if found is None or (status == _INTERRUPTED and "::" not in found[1]):
            raise NotTriedError(f"pytest ended with status {status}: {said[-600:]}")
        return found[1], (found[2] or "")[:200]

    def _pytest(self, copy: Path, tests: list[str]) -> tuple[int, str]:
        data = os.environ.get("MRSTRAIN_TEST_DATA", str(ROOT.parent / "shared" / "data"))
        settings = {"PYTHONPATH": str(copy), "MRSTRAIN_TEST_DATA": data, "COLUMNS": "400"}
        with subprocess.Popen(
            [*PYTEST, *self._suite, *tests], cwd=copy, start_new_session=True, text=True, stdin=subprocess.DEVNULL,
            env={k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | settings,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        ) as running:  # fmt: skip
            try:
                said, _ = running.communicate(timeout=self._limit_s)
            except subprocess.TimeoutExpired:
                os.killpg(running.pid, signal.SIGKILL)
                raise NotTriedError(f"{' '.join(tests)} took over {self._limit_s / 60.0:.0f} minutes") from None
        return running.returncode, said


def seed(copy: Path, fault: dict[str, Any]) -> None:
    """Replace a fault's text in a copy of the sources."""
    file = copy / fault["file"]
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    if text.count(fault["find"]) != 1:
        raise NotTriedError(f"its text stands {text.count(fault['find'])} times in {fault['file']}, and has to once")
    file.write_text(text.replace(fault["find"], fault["replace"]), encoding="utf-8")
    if "njit" in text:  # compiled callers in other files have what they call in them
        for kernel in copy.rglob("*.nb[ic]"):
            kernel.unlink()


def main() -> int:
    """Try the faults that the command line names; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", action="append", metavar="NAME", help="of a fault; repeat for several")
    parser.add_argument("--suite", choices=SUITES, default="short", help="the tests that are tried")
    parser.add_argument("--own", action="store_true", help="no more than the tests that a fault names")
    parser.add_argument("--jobs", type=int, default=1, help="faults at once")
    parser.add_argument("--limit-minutes", type=float, default=60.0, help="of each run of pytest")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("results.json"))
    asked = parser.parse_args()
    listed = tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8"))["fault"]
    faults = {fault["name"]: fault for fault in listed}
    if len(faults) < len(listed) or not set(asked.only or faults) <= set(faults):
        parser.error(f"faults have names of their own, and --only is one of {', '.join(faults)}")
    results = json.loads(asked.out.read_text(encoding="utf-8")) if asked.out.is_file() else {}
    head = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    chosen, writing = [fault for fault in listed if fault["name"] in (asked.only or faults)], Lock()
    with tempfile.TemporaryDirectory(prefix="faults-") as folder, ThreadPoolExecutor(asked.jobs) as pool:
        trial = Trial(Path(folder), SUITES[asked.suite], 60.0 * asked.limit_minutes, asked.own)

        def one(fault: dict[str, Any]) -> str:
            told = trial.run(fault) | {"suite": asked.suite, "commit": head.stdout.strip()}
            with writing:
                results[fault["name"]] = told
                ordered = {name: results[name] for name in faults if name in results}
                asked.out.write_text(json.dumps(ordered, indent=2) + "\n", encoding="utf-8")
            print(f"{fault['name']}: {told['outcome']} after {told['seconds']:.0f} s {told['by']}", flush=True)
            return str(told["outcome"])

        outcomes = list(pool.map(one, chosen))
    print(", ".join(f"{outcomes.count(each)} {each}" for each in dict.fromkeys(outcomes)), f"of {len(outcomes)} faults")
    return 0 if set(outcomes) <= {"caught"} else 1


if __name__ == "__main__":
    sys.exit(main())
