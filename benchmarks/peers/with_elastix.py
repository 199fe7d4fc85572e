"""elastix' own default B-spline: mutual information, control points every 10 mm; nothing tuned.

    python -m benchmarks.peers.with_elastix FOLDER THREADS [as-acquired]

in mrstrain's environment. ``as-acquired``: without mask and with the shading, as in `benchmarks.registration_accuracy`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks.registration_accuracy import elastix_default
from dvc import Mask, read_image
from dvc.io.transforms.write import write_elastix_transform
from dvc.worker import Worker


def main() -> None:
    folder, threads = Path(sys.argv[1]), int(sys.argv[2])
    if "as-acquired" in sys.argv:
        reference, moving, mask = read_image(folder / "scan0.mha"), read_image(folder / "scan1-moved.mha"), None
    else:
        reference, moving = read_image(folder / "reference.mha"), read_image(folder / "loaded.mha")
        inside = read_image(folder / "mask.mha")
        mask = Mask(inside.grid, inside.values > 0)
    with Worker(threads) as worker:
        found = elastix_default(reference, moving, mask, worker, seed=1)
    write_elastix_transform(folder, found, None, reference.grid)[0].rename(folder / "found.txt")


if __name__ == "__main__":
    main()
