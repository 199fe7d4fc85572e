"""Where the error of a measured strain comes from: one cause at a time is taken away.

    python -m benchmarks.error_budget --work FOLDER --out benchmarks/results/error_budget.json   # an hour on one core

Whole heels at 0.8 mm with exact labels: two that a finite-element model presses (motions and work folder are those of
`benchmarks.unforeseen`), and two of the accuracy study. The first row is the measurement as it is, at SNR 25. All
others are of images without noise, with one thing changed: no receive field, a body mask three voxels wider, control
points every 2.4 mm, and each weight of the regularisation smaller or larger. Root mean square error, and mean error,
of the maximum shear strain by tissue.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation

from benchmarks.hidden_law import as_motion, truth
from benchmarks.unforeseen import KINDS, SOFT, VOXEL_MM, simulated
from dvc import Deformation, GaussNewtonWithInterfaces, Image, LabelMap, Mask, RigidMotion, Settings, register
from dvc.deformation.protocol import Motion
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from phantoms import (
    FAT_SIGNAL,
    TISSUES,
    AccuracyCase,
    Heel,
    acquire,
    covering,
    heel_grid,
    labels_of,
    motion_named,
    random_foot_motion,
    sampled_errors,
)
from phantoms.heel import octants
from phantoms.mri import sampled_by
from validate import read_result

ENGINE, SNR, NEAR_MM = "gauss-newton-borders", 25.0, 1.5
Change = Callable[[GaussNewtonWithInterfaces], GaussNewtonWithInterfaces]


@dataclass(frozen=True)
class Row:
    """What is changed in one row of the budget."""

    name: str
    snr: float | None = None
    receive_field: bool = True
    wider: int = 0  # voxels
    change: Change = lambda engine: engine


def weights(**of: float) -> Change:
    """Change the parameters of the smooth spline."""
    return lambda engine: replace(engine, smooth=replace(engine.smooth, **of))


def skin(weight: float) -> Change:
    """Fix the weight of strain in the skin."""
    return lambda engine: replace(engine, skin=weight)


ROWS = (
    Row("as measured, SNR 25", SNR),
    Row("no noise"),
    Row("no noise, no receive field", receive_field=False),
    Row("no noise, body mask 3 voxels wider", wider=3),
    Row("no noise, control points every 2.4 mm", change=weights(spacing_mm=2.4)),
    Row("no noise, bending 0.1/mm", change=weights(bending=0.1)),
    Row("no noise, bending 10/mm", change=weights(bending=10.0)),
    Row("no noise, volume 30/mm3", change=weights(volume=30.0)),
    Row("no noise, volume 3000/mm3", change=weights(volume=3000.0)),
    Row("no noise, skin 0.01/mm3", change=skin(0.01)),
    Row("no noise, skin 30/mm3", change=skin(30.0)),
    Row("no noise, skin 300/mm3", change=skin(300.0)),
)
MOTIONS = (("trebbi", 7, "Load1"), ("stiff-skin", 7, "Load1"), ("", 3, "Load3"), ("", 3, "smooth"))


def moved(work: Path, kind: str, seed: int, load: str) -> tuple[Motion, Deformation]:
    """The motion that makes the image, and the truth that the strain is compared with."""
    if kind not in KINDS:
        motion = motion_named(Heel(seed), load)
        assert motion is not None
        return motion, motion
    folder, meshed = simulated(work, kind)
    return as_motion(truth(folder, load, meshed), meshed), read_result(kind, folder / f"{load}.vtu").deformation


def image(heel: Heel, labels: LabelMap, row: Row, number: int, motion: Motion | None, foot: RigidMotion) -> Image:
    """An image of the heel, as `phantoms.scan` makes it, with or without noise and receive field."""
    grid = labels.grid if motion is None else covering(labels.grid, foot.apply(labels.region("bone").points()))
    signal = octants(heel, sampled_by(grid), motion, foot)
    noise, field = (int(s) for s in np.random.SeedSequence([heel.seed, 2, number]).generate_state(2))
    of_field = field if row.receive_field else None
    return acquire(signal, grid, snr=row.snr, reference_signal=FAT_SIGNAL, seed=noise, bias_seed=of_field)


def measured(work: Path, kind: str, seed: int, load: str, rows: list[Row]) -> dict[str, dict[str, list[float]]]:
    """The budget of one motion."""
    heel, grid = Heel(seed), heel_grid(VOXEL_MM)
    labels = labels_of(heel, grid)
    motion, true = moved(work, kind, seed, load)
    number, body = zlib.crc32(f"{kind}-{load}".encode()), labels.labels > 0
    foot, found = random_foot_motion(seed, number), {}
    case = AccuracyCase(ENGINE, VOXEL_MM, SNR, f"{kind}-{load}", seed)
    with Worker(threads=1) as worker:
        for row in rows:
            both = (None, RigidMotion.identity()), (motion, foot)
            images = [image(heel, labels, row, number + (of is not None), of, placed) for of, placed in both]
            engine = Settings.of(ENGINE).engine
            assert isinstance(engine, GaussNewtonWithInterfaces)
            settings = replace(Settings.of(ENGINE), engine=row.change(engine.keeping_volume()))
            tissue = binary_dilation(body, iterations=row.wider) if row.wider else body
            one = register(
                *images, bone=labels.region("bone"), tissue=Mask(grid, tissue), labels=labels, settings=settings,
                worker=worker,
            )  # fmt: skip
            sampled = sampled_errors(case, labels, body, true, one)
            error, numbers = sampled.shear - sampled.true_shear, {name: number for number, name in TISSUES.items()}
            parts = {tissue: sampled.tissue == numbers[tissue] for tissue in SOFT}
            parts["fat near bone"] = parts["fat"] & (sampled.to_bone_mm < NEAR_MM)
            found[row.name] = {
                name: [round(float(np.sqrt(np.mean(error[of] ** 2))), 4), round(float(error[of].mean()), 4)]
                for name, of in parts.items()
            }
            print(kind, load, row.name, found[row.name], flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    named = {f"{kind or 'flow'}-{load}": (kind, seed, load) for kind, seed, load in MOTIONS}
    parser.add_argument("--rows", nargs="+", choices=[row.name for row in ROWS], help="only these rows")
    parser.add_argument("--motions", nargs="+", choices=list(named), help="only these motions")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    rows = [row for row in ROWS if given.rows is None or row.name in given.rows]
    budget = {name: measured(given.work, *of, rows) for name, of in named.items() if name in (given.motions or named)}
    if given.out is not None:
        given.out.write_text(json.dumps({"versions": versions(), "error_and_bias": budget}, indent=1) + "\n")


if __name__ == "__main__":
    main()
