"""Quality and time of meshes of a label map, and time to evaluate a displacement on them at every voxel of its image.

    python -m benchmarks.meshing tissues_to_mesh.nii.gz --edge-mm 2.8 --rounds 2 --out benchmarks/results/meshing.json

The label map is one that `mrstrain phantom` wrote, its names beside it. Meshes differ from run to run: each is made
anew. The displacement is one that changes from node to node; its gradient is evaluated with it. Runs are added to those
that the file holds.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from dvc import read_labels
from dvc.deformation.nodal import OnMesh
from fe import mesh_labels
from mrstrain.records.provenance import versions


def processor_s() -> float:
    """Seconds of processor time so far, of this process and of its children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(of.ru_utime + of.ru_stime for of in used)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("--edge-mm", type=float, nargs="+", required=True)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    labels = read_labels(given.labels, given.labels.with_name(given.labels.name.replace(".nii.gz", ".csv")))
    points = labels.grid.points().reshape(-1, 3)
    rows = json.loads(given.out.read_text())["rows"] if given.out.is_file() else []
    for edge_mm in given.edge_mm * given.rounds:
        began, before = time.perf_counter(), processor_s()
        mesh, quality = mesh_labels(labels, edge_mm)
        meshed, processor = time.perf_counter() - began, processor_s() - before
        moved = OnMesh(mesh, np.sin(mesh.points_mm / 10.0))
        times = []
        for _ in range(3):
            began = time.process_time()
            moved.evaluate(points)
            times.append(time.process_time() - began)
        volumes = {name: made / asked - 1.0 for name, made, asked in quality.volumes_ml}
        rows.append(
            {
                "edge_mm": edge_mm, "voxel_mm": labels.grid.spacing_mm.tolist(), "meshing_s": meshed,
                "meshing_cpu_s": processor, "volume_errors": volumes, "points": len(points), "evaluation_cpu_s": times,
                "quality": asdict(quality),
            }
        )  # fmt: skip
        given.out.write_text(json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
        print({k: v for k, v in rows[-1].items() if k != "quality"}, quality.cells, quality.least_angle_deg, flush=True)


if __name__ == "__main__":
    main()
