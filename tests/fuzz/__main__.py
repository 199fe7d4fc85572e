"""Does a reader of files survive damage? Every reader, on damaged copies of small valid files.

    python -m tests.fuzz                         every reader of readers.py, a minute each
    python -m tests.fuzz nifti dicom --seconds 5 two of them, shorter
    python -m tests.fuzz nifti --again FILE      read a kept file again

A reader has to read a file or refuse it with an error of mrstrain (`dvc.errors`). An escape is any other error, no
answer within the limit, or a process that died; the first of each kind is kept, with the files beside it and what
happened (told.txt). Each reader runs in a process of its own, of limited memory. Exit status 1 if something escaped.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.fuzz.damage import Reader
from tests.fuzz.trials import read_again, tried


def main(readers: Mapping[str, Reader], given: Sequence[str] | None = None) -> int:
    """Try the readers that the command line names; the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("readers", nargs="*", metavar="READER", help=f"of {', '.join(readers)}; all by default")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each reader")
    parser.add_argument("--limit-s", type=float, default=5.0, help="for each file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=Path("out") / "fuzz", metavar="FOLDER", help="of what escaped")
    parser.add_argument("--again", type=Path, metavar="FILE", help="read this file by the one reader that is named")
    asked = parser.parse_args(given)
    if unknown := set(asked.readers) - set(readers):
        parser.error(f"no reader is called {', '.join(sorted(unknown))}")
    if asked.again and not (len(asked.readers) == 1 and asked.again.is_file()):
        parser.error("--again takes a file and the one reader that is to read it")
    if asked.again:
        return read_again(readers[asked.readers[0]].read, asked.again, 4.0 * asked.limit_s)  # with its imports
    print(f"{asked.seconds:g} s for each reader, seed {asked.seed}", flush=True)
    found = {name: tried(name, readers[name], asked) for name in asked.readers or readers}
    for name, escapes in found.items():
        for what, path in escapes.items():
            print(f"{name}: {what}\n    python -m tests.fuzz {name} --again '{path}'")
    return 1 if any(found.values()) else 0


if __name__ == "__main__":
    from tests.fuzz.readers import READERS

    sys.exit(main(READERS))
