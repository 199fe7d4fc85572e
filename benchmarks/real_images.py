"""Real images made by others: what the registration says of pairs whose truth is (partly) known.

    python benchmarks/real_images.py DATA_FOLDER [--out benchmarks/results/real_images.json]

- leg-mr: the last five slices of one stack and the first five of the next are two scans of the same tissue (truth: no
  strain; five slices of 6 mm, so the in-plane components matter).
- leg-mr water and fat: one scan, contrast turned round. Must be refused.
- brain-pair: two volumes of a functional series, oblique; no strain but the brain's pulsation.
- knee-dicom: a DICOM series is read; its twin, noise added and moved by 2 mm and 3 degrees, must be found again.
- lung-landmarks: others' elastix transforms, judged by 100 landmark pairs.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dvc import (
    Grid,
    Image,
    Registration,
    RigidMotion,
    Settings,
    StrainField,
    local_correlation,
    noise_floor,
    read_image,
    read_transform,
    register,
    strain_maps,
    tissue_mask,
)
from dvc.deformation.protocol import displacement_on_grid
from dvc.errors import MrstrainError
from dvc.images.resample import carry
from dvc.threads import usable_cores
from dvc.worker import Worker
from mrstrain.records.provenance import versions


def floor_of(found: Registration) -> dict[str, float]:
    maps = strain_maps(found.deformation, found.tissue)
    floor = noise_floor(maps, found.tissue.inside)
    loaded, motion = found.loaded, found.alignment.motion
    grid = found.reference.grid
    after = carry(loaded, grid, motion, displacement_mm=displacement_on_grid(found.displacement, grid, np.float32))
    E = maps.green_lagrange[maps.valid & found.tissue.inside].astype(float)
    half = np.sqrt(((E[:, 0] - E[:, 3]) / 2) ** 2 + E[:, 1] ** 2)  # in-plane maximum shear strain, x and y
    return {
        "maer": floor.maer,
        "sder": floor.sder,
        "max_shear_p50": floor.max_shear_p50,
        "max_shear_p95": floor.max_shear_p95,
        "in_plane_shear_p50": float(np.percentile(half, 50)),
        "in_plane_shear_p95": float(np.percentile(half, 95)),
        "displacement_p95_mm": floor.displacement_p95_mm,
        "local_similarity_after": local_correlation(found.reference, after, found.tissue)[1],
    }


def repeat_of_leg(data: Path, worker: Worker, settings: Settings) -> dict[str, float]:
    first, second = (read_image(data / "leg-mr" / f"Join_{n}.nii.gz") for n in (2, 3))
    grid = Grid((*first.grid.shape[:2], 5), first.grid.spacing_mm, first.grid.origin_mm, first.grid.direction)
    below, above = Image(grid, first.values[:, :, -5:]), Image(grid, second.values[:, :, :5])
    found = register(below, above, settings=settings, worker=worker)
    return floor_of(found)


def inverted_contrast(data: Path, worker: Worker, settings: Settings) -> dict[str, str]:
    water, fat = (read_image(data / "leg-mr" / f"{name}.nii.gz") for name in ("water", "fat"))
    try:
        register(water, fat, settings=settings, worker=worker)
    except MrstrainError as refusal:
        return {"refused": str(refusal)}
    return {"refused": "NO"}


def brain_pair(data: Path, worker: Worker, settings: Settings) -> dict[str, float]:
    first, second = (read_image(data / "brain-pair" / "example4d.nii.gz", volume=n) for n in (0, 1))
    return floor_of(register(first, second, settings=settings, worker=worker))


def knee_series(data: Path, worker: Worker, settings: Settings) -> dict[str, float]:
    knee = read_image(data / "knee-dicom")
    motion = RigidMotion.about(
        knee.grid.centre_mm, Rotation.from_rotvec([0.0, 2.0, 2.2], degrees=True).as_matrix(), np.array([1.2, -1.5, 0.6])
    )
    sigma = 0.03 * float(np.percentile(knee.values, 99))
    noise = np.random.default_rng(1).normal(scale=sigma, size=knee.grid.shape)
    twin = Image(knee.grid.moved_by(motion.rotation, motion.translation_mm), knee.values + noise.astype(np.float32))
    found = register(knee, twin, settings=settings, worker=worker)
    X = tissue_mask(knee).points()[::50]
    error = np.linalg.norm(found.alignment.motion.apply(X) - motion.apply(X), axis=1)
    return {"slices": min(knee.grid.shape), "rigid_error_p95_mm": float(np.percentile(error, 95)), **floor_of(found)}


def lung_transforms(data: Path) -> dict[str, float]:
    folder = data / "lung-landmarks"

    def points(name: str) -> np.ndarray:
        return np.loadtxt(folder / name, skiprows=2)

    fixed, moving = points("3DCT_lung_baseline_landmarks.txt"), points("3DCT_lung_groundtruth_point.txt")
    with tempfile.TemporaryDirectory() as scratch:
        text = (folder / "TransformParameters_3DCT_lung.NC.bspline.ASGD.001a.txt.in").read_text()
        affine = "transformparameters.3DCT_lung.affine.txt"
        (Path(scratch) / affine).write_text((folder / affine).read_text())
        (Path(scratch) / "bspline.txt").write_text(re.sub(r"@ELASTIX_DATA_DIR@/", "", text))
        chain = read_transform(Path(scratch) / "bspline.txt")
        rigid = read_transform(Path(scratch) / affine)
    u, H = chain.evaluate(fixed)
    defined = np.isfinite(u).all(axis=1)

    def miss(x: np.ndarray) -> float:
        return float(np.linalg.norm(x - moving, axis=1)[defined].mean())

    return {
        "landmarks": len(fixed),
        "landmarks_inside_the_spline": int(defined.sum()),
        "identity_mm": miss(fixed),
        "affine_mm": miss(fixed + rigid.displacement(fixed)),
        "affine_and_bspline_mm": miss(fixed + u),
        "lowest_jacobian": float(np.nanmin(StrainField.from_gradient(H).jacobian)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--by", default="gauss-newton", help="the engine gauss-newton, or a preset of elastix")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    settings = Settings.of(given.by, align_on="image", threads=usable_cores())
    results: dict[str, object] = {
        "by": given.by,
        "versions": versions(),
        "lung transforms": lung_transforms(given.data),
    }
    print("lung transforms", json.dumps(results["lung transforms"], indent=1))
    with Worker(settings.threads) as worker:
        for name, run in (
            ("brain pair", brain_pair),
            ("water against fat", inverted_contrast),
            ("knee DICOM, moved twin", knee_series),
            ("leg repeat", repeat_of_leg),
        ):
            try:
                results[name] = run(given.data, worker, settings)
            except MrstrainError as failure:
                results[name] = {"failed": str(failure)}
            print(name, json.dumps(results[name], indent=1), flush=True)
            if given.out is not None:
                given.out.parent.mkdir(parents=True, exist_ok=True)
                given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
