"""Large motion: error and verdict where tissue moves by up to 16 mm and shears up to 1, at once and in two steps.

    python -m benchmarks.large_motion --work /tmp/large --out benchmarks/results/large_motion.json

A phantom heel set aside (seed 9300) under two motions, each at two sizes; registered with labels by the default engine,
from the bone alone and, `--chain`, from the same motion at half its size. Scored are the voxels that the result calls
valid.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from dvc import Composed, read_labels, read_mask, write_image, write_labels
from dvc.deformation.protocol import Motion
from dvc.io.result_folder import spline_in
from mrstrain import register
from mrstrain.records.provenance import versions
from phantoms import (
    Heel,
    centred_grid,
    errors_by_tissue,
    labels_of,
    pressed,
    random_foot_motion,
    scan,
    sliding,
    under_plate,
)

SEED, SNR = 9300, 25.0
SHAPE, SPACING_MM = (126, 140, 132), 0.8


def pressed_and_slid(heel: Heel, size: float) -> Motion:
    return Composed([sliding(heel, 3.0 * size), under_plate(heel, press_mm=6.0 * size, shear_mm=0.0)])


MOTIONS: dict[str, tuple[Callable[[Heel, float], Motion], tuple[float, ...]]] = {
    "smooth": (pressed, (1.4, 1.8)),
    "Load1": (pressed_and_slid, (1.5, 2.0)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    work: Path = given.work
    work.mkdir(parents=True, exist_ok=True)
    heel, grid = Heel(SEED), centred_grid(SHAPE, SPACING_MM)
    labels = labels_of(heel, grid)
    write_labels(work / "tissues.nii.gz", labels)
    (work / "tissues.csv").write_text("label,name\n" + "".join(f"{n},{name}\n" for n, name in labels.names.items()))
    write_image(work / "Load0.nii.gz", scan(heel, grid, snr=SNR, number=0))
    rows = []
    for name, (motion, sizes) in MOTIONS.items():
        for size in sizes:
            images = []
            for number, part in enumerate((0.5, 1.0), start=1):
                image = work / f"{name}-{part * size:g}.nii.gz"
                if not image.is_file():
                    foot = random_foot_motion(SEED, number)
                    write_image(image, scan(heel, grid, motion(heel, part * size), foot, snr=SNR, number=number))
                images.append(image)
            for chain in (False, True):
                out = work / f"{name}-{size:g}-{'chained' if chain else 'at-once'}"
                folder = out / images[1].name.removesuffix(".nii.gz")
                if not (folder / "quality.json").is_file():
                    register(
                        work / "Load0.nii.gz", images if chain else images[1:], out=out, bone_label="bone", chain=chain,
                        labels=work / "tissues.nii.gz", names=work / "tissues.csv", workers=1, threads=1,
                    )  # fmt: skip
                told = json.loads((folder / "quality.json").read_text())
                valid = read_mask(folder / "valid.nii.gz").inside
                known = read_labels(work / "tissues.nii.gz", work / "tissues.csv")
                errors = errors_by_tissue(known, motion(heel, size), spline_in(folder), valid)
                row = {
                    "motion": name,
                    "size": size,
                    "chained": chain,
                    "verdict": told["verdict"],
                    "errors": [asdict(error) for error in errors],
                }
                rows.append(row)
                print(name, size, "chained" if chain else "at once", told["verdict"])
                for error in errors:
                    print(f"  {error.tissue}: true p95 {error.true_p95:.2f}, RMSE {error.shear_rmse:.3f}, "
                          f"bias {error.shear_bias:+.3f}, u {error.u_p50_mm:.2f} / {error.u_p95_mm:.2f} mm, "
                          f"folded {error.folded}")  # fmt: skip
                given.out.write_text(json.dumps({"versions": versions(), "seed": SEED, "cases": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
