"""`mrstrain register` on the pair of the demonstration, beside elastix' fit alone on a 4 mm grid, and as a first run.

    git worktree add ../before COMMIT
    python -m benchmarks.command_beside_elastix --before ../before --out benchmarks/results/command_beside_elastix.json

Images of 126 x 140 x 132 voxels as `mrstrain phantom` writes them, on all cores. In each round, in turn: the command of
the tree before and of this one, with one smooth spline, with a bone mask alone and with labels; elastix' fit alone
(`four_mm.txt`: 250 iterations at each of four resolutions), on the images as they are, in the mask of the tissue, in a
process that has loaded elastix and started from the known motion of the bone; and this tree's command without any
compiled loop on disk. Wall and processor seconds, and the peak memory of the commands.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.before_after import KINDS, run
from dvc import AlignedPair, Settings, tissue_mask, write_image, write_labels, write_mask
from dvc.registration.elastix import run as elastix
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from phantoms import HeelPair, heel_pair

HERE = Path(__file__).resolve().parents[1]
FOUR_MM = Path(__file__).with_name("four_mm.txt")


def written(pair: HeelPair, folder: Path) -> None:
    """Images, bone and label map, as files."""
    write_image(folder / "Load0.nii.gz", pair.reference)
    write_image(folder / "Load1.nii.gz", pair.loaded)
    write_mask(folder / "bone.nii.gz", pair.bone)
    write_labels(folder / "tissues.nii.gz", pair.labels)


def fit(pair: HeelPair, worker: Worker) -> dict[str, float]:
    """elastix' fit alone."""
    engine = Settings.of(str(FOUR_MM)).engine
    aligned = AlignedPair.of(
        pair.reference, pair.loaded, pair.foot_motion, tissue_mask(pair.reference), pair.bone, None
    )
    began = time.perf_counter()
    engine.find(aligned, start=None, seeds=(1,), worker=worker, progress=lambda *_: None)
    return {"wall_s": round(time.perf_counter() - began, 2)}


def measured(before: Path, rounds: int) -> dict[str, list[dict[str, float]]]:
    pair = heel_pair(seed=1, load=0.6)
    runs: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as place, Worker(os.cpu_count() or 1) as worker:
        folder = Path(place)
        written(pair, folder)
        worker.run("loading elastix", elastix.self_test)
        for number in range(rounds + 1):  # the first stores the compiled loops of both trees
            for kind in KINDS:
                taken = {
                    f"before, {kind}": run(before, folder, kind, folder / "before"),
                    f"after, {kind}": run(HERE, folder, kind, folder / "after"),
                    f"after, {kind}, nothing compiled": run(
                        HERE, folder, kind, folder / "first", {"NUMBA_CACHE_DIR": str(folder / f"{number}-{kind}")}
                    ),
                }
                for name, told in taken.items():
                    runs.setdefault(name, []).append(told)
            runs.setdefault("elastix, 4 mm, fit alone", []).append(fit(pair, worker))
    return {name: told[1:] for name, told in runs.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    runs = measured(given.before.resolve(), given.rounds)
    middle = {
        name: {key: round(float(np.median([one[key] for one in told])), 2) for key in told[0]}
        for name, told in runs.items()
    }
    results = {"versions": versions(), "cores": os.cpu_count(), "voxels": [126, 140, 132], "runs": runs}
    given.out.write_text(json.dumps(results | {"medians": middle}, indent=1) + "\n")
    print(json.dumps(middle, indent=1))


if __name__ == "__main__":
    main()
