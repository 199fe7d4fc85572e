"""How often the error bars hold when the label map is made from the image: on heels that no error model has seen.

    python -m benchmarks.labels_coverage --seeds 9002 9003 --out labels_coverage.json --samples FOLDER

Each heel is labelled from the unloaded image and the mask of its bone (`label_tissues`), registered with these labels,
and compared with the error model for label maps that comes with mrstrain. All motions at 0.8 mm and SNR 25; at the
other conditions of the accuracy study, four of them. Root mean square errors of the max. shear by tissue of the label
map that was made, share of the voxels whose truth lies within 1.96 standard deviations, and share of the tissues'
figures (median, percentiles, volumes) within their intervals.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path

import numpy as np

from dvc import Image, LabelMap, Mask, label_tissues
from dvc.threads import usable_cores
from dvc.trust.error_model import error_model_of
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from mrstrain.truth.accuracy import CONDITIONS, MOTIONS
from phantoms import TISSUES, AccuracyCase, ErrorSamples, coverage_rows, error_rows, measure_run

ENGINE = "gauss-newton-borders"
FEW = ("smooth", "sliding", "Load1", "Load3")
USUAL = CONDITIONS[0]


def cases(seeds: Sequence[int]) -> Iterator[AccuracyCase]:
    for spacing, snr in CONDITIONS:
        for motion in MOTIONS if (spacing, snr) == USUAL else FEW:
            for seed in seeds:
                yield AccuracyCase(ENGINE, spacing, snr, motion, seed)


def from_image(image: Image, bone: Mask) -> LabelMap:
    """Labels made from the image, numbered as the phantom's are."""
    made, numbers = label_tissues(image, bone).labels, {name: number for number, name in TISSUES.items()}
    labels = np.zeros_like(made.labels)
    for number, name in made.names.items():
        labels[made.labels == number] = numbers["ankle" if name == "other bone" else name]
    return LabelMap(made.grid, labels, dict(TISSUES))


def measured(case: AccuracyCase, folder: Path) -> ErrorSamples:
    """Samples of a case, kept in a folder."""
    kept = folder / f"{case.name}.npz"
    found = ErrorSamples.read(kept, lambda _: "from image")
    if found is None:
        with Worker(usable_cores()) as worker:
            found = measure_run(case, worker, nullcontext(), lambda _: None, from_image)
        found.write(kept, "from image")
    return found


def figures(runs: Sequence[ErrorSamples]) -> dict[str, object]:
    model = error_model_of(ENGINE)
    assert model is not None
    coverage = coverage_rows(runs, model)
    near = ("fat", "distance to bone, mm")
    errors = [row for row in error_rows(runs) if row.by == "all" or (row.tissue, row.by) == near]
    return {"coverage": [asdict(row) for row in coverage], "errors": [asdict(row) for row in errors]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--samples", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.samples.mkdir(parents=True, exist_ok=True)
    runs = []
    for case in cases(given.seeds):
        runs.append(measured(case, given.samples))
        print(case.name, f"{runs[-1].seconds:.0f} s", flush=True)
        given.out.write_text(json.dumps({"versions": versions(), **figures(runs)}, indent=1) + "\n")


if __name__ == "__main__":
    main()
