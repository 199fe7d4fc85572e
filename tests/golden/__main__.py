"""The golden record, from the command line, in the root of the repository.

    python -m tests.golden                   make every scene anew and check it against the record
    python -m tests.golden --write           write the record anew
    python -m tests.golden --write study     of one scene alone; the others stay

Write it only where figures are meant to change, and say in the commit which did and why: ``git diff tests/golden``
shows them. ``--threads 2`` tells whether results hang on the number of threads. The test is `test_golden`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.golden.reading import quantities
from tests.golden.record import check, write_record
from tests.golden.scenes import SCENES


def main() -> int:
    """Exit status 1 where something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description="Write or check the golden record.")
    parser.add_argument("scenes", nargs="*", help=f"of {', '.join(SCENES)}; all by default")
    parser.add_argument("--write", action="store_true", help="write the record instead of checking it")
    parser.add_argument("--threads", type=int, default=1)
    asked = parser.parse_args()
    unknown = set(asked.scenes) - set(SCENES)
    if unknown:
        parser.error(f"no scene is called {', '.join(sorted(unknown))}")
    wrong = 0
    for scene in asked.scenes or SCENES:
        with tempfile.TemporaryDirectory() as place:
            found = quantities(SCENES[scene](Path(place), asked.threads))
        if asked.write:
            write_record(scene, found)
            print(f"{scene}: {len(found)} quantities written")
            continue
        differing, words = check(scene, found)
        wrong += len(differing)
        print("\n  ".join([f"{scene}: {words}", *differing]), flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
