"""Power of the probability that a field represents the measurement: right, wrong and no strain on phantom heels.

    python -m benchmarks.representation --out benchmarks/results/representation.json

The measurement is the true maximum shear strain of Load1 in voxels of 2 mm, with bias and noise drawn from the error
model of gauss-newton-borders (0.8 mm, SNR 25). It is compared with the true field, with 0.9, 1.2 and 1.5 times that,
with the true fields of the smooth load and of Load3, and with no strain: by the uncertainty of each coefficient, and by
the one uncertainty that CWA 16799 gives to all.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy import sparse

from dvc import StrainField
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.protocol import Motion
from dvc.images.depth import to_surface_mm
from dvc.trust.error_model import error_model_of
from dvc.trust.truth_draws import TruthDraws
from mrstrain.records.provenance import versions
from phantoms import RIGID, Heel, heel_grid, labels_of, labels_to_mesh, pressed, under_load
from validate import CellGraph, decompose, representation

DRAWS = 60


def voxels(inside: BoolArray, points_mm: FloatArray, volume_ml: float) -> CellGraph:
    """Voxels as cells that are neighbours across their faces."""
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(np.count_nonzero(inside))
    pairs = []
    for axis in range(3):
        along = np.moveaxis(number, axis, 0)
        both = np.stack([along[1:].ravel(), along[:-1].ravel()])
        pairs.append(both[:, (both >= 0).all(axis=0)])
    first, second = np.concatenate(pairs, axis=1)
    count = len(points_mm)
    graph = sparse.csr_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return CellGraph(np.full(count, volume_ml), points_mm, graph)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    model = error_model_of("gauss-newton-borders")
    assert model is not None
    table, rows = model.table_for(np.full(3, 0.8), 25.0), []
    for seed in given.seeds:
        heel, grid = Heel(seed), heel_grid(2.0)
        labels = labels_to_mesh(heel, labels_of(heel, grid))
        bone = np.isin(labels.labels, [number for number, name in labels.names.items() if name in RIGID])
        soft = (labels.labels > 0) & ~bone
        points, to_bone = grid.points(soft), to_surface_mm(bone, grid.spacing_mm)[soft]
        tissue = np.array([labels.names[number] for number in labels.labels[soft]])
        cells = voxels(soft, points, float(grid.spacing_mm.prod()) / 1000.0)

        def shear(motion: Motion, at: FloatArray = points) -> FloatArray:
            return StrainField.from_gradient(motion.evaluate(at)[1]).max_shear

        true = shear(under_load(heel, "Load1"))
        drawn = TruthDraws(points, true, tissue.tolist(), to_bone, table, seed=100 + seed).drawn()
        measured = np.maximum(2.0 * true - drawn, 0.0)  # the true strain and an error: a draw is it less one
        draws = TruthDraws(points, measured, tissue.tolist(), to_bone, table, seed=seed)
        truths = np.array([draws.drawn() for _ in range(DRAWS)])
        fields = {"true": true} | {f"{share:g} times": share * true for share in (0.9, 1.2, 1.5)}
        fields |= {"smooth load": shear(pressed(heel)), "Load3": shear(under_load(heel, "Load3")), "none": 0.0 * true}
        for name in ("fat", "muscle", "skin"):
            here = tissue == name
            bias, sd = table.expected(name, measured[here], to_bone[here])
            u_cal = float(np.sqrt(np.mean(bias**2 + sd**2)))
            of = {field: values[here] for field, values in fields.items()}
            by = decompose(measured[here], of, cells.part(here), u_cal, truths[:, here], table.factor)
            rows += [{"seed": seed} | asdict(representation((field, "Load1", name), by)) for field in of]
    for row in rows:
        print(*(f"{value:.3g}" if isinstance(value, float) else value for value in row.values()))
    if given.out is not None:
        given.out.write_text(json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
