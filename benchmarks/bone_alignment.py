"""Error and time of the rigid alignment on the bone, beside elastix' from the same starts.

    python -m benchmarks.bone_alignment --seeds 201 202 203 204 205 206 --out benchmarks/results/bone_alignment.json

Phantom heels pressed and moved (0.8 mm, SNR 25), shading removed, without and with a twentieth of the range as noise on
top; starts that are off by up to 1.5 mm along and 3 degrees about each axis. Errors are root mean squares over the
bone's voxels, mm. elastix (its parameters: `bone_rigid.txt`) runs with two seeds, and the motion midway is taken; it is
warmed up beforehand. All in one process.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dvc import Image, Mask, RigidMotion, read_parameter_file
from dvc.images.bias_field import without_bias_field
from dvc.io.transforms.read import rigid_from_elastix
from dvc.registration.elastix import run as elastix
from dvc.registration.rigid_fit import RigidFit
from mrstrain.records.provenance import versions
from phantoms import HeelPair, heel_pair

RIGID = Path(__file__).with_name("bone_rigid.txt")


def off_mm(mask: Mask, a: RigidMotion, b: RigidMotion) -> float:
    X = mask.points()
    return float(np.sqrt(np.mean(np.sum((a.apply(X) - b.apply(X)) ** 2, axis=1))))


def midway(motions: list[RigidMotion], centre: np.ndarray) -> RigidMotion:
    turn = Rotation.from_matrix(np.stack([motion.rotation for motion in motions])).mean().as_matrix()
    return RigidMotion(turn, np.mean([motion.apply(centre[None])[0] for motion in motions], axis=0) - turn @ centre)


def by_elastix(fixed: Image, moving: Image, bone: Mask, start: RigidMotion, seed: int) -> RigidMotion:
    back = start.inverse()
    moved = Image(moving.grid.moved_by(back.rotation, back.translation_mm), moving.values)
    with tempfile.TemporaryDirectory() as folder:
        parameters = read_parameter_file(RIGID).complete(seed=seed)
        found = elastix.register(fixed, moved, parameters, bone, None, None, folder)
    return start.after(rigid_from_elastix(found))


def one(pair: HeelPair, seed: int, noise: float) -> dict[str, object]:
    random = np.random.default_rng(seed)
    fixed, moving = (without_bias_field(noisy(image, noise, random)) for image in (pair.reference, pair.loaded))
    centre = pair.bone.points().mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(random.uniform(-3.0, 3.0, 3))).as_matrix()
    start = pair.foot_motion.after(RigidMotion.about(centre, turn, random.uniform(-1.5, 1.5, 3)))
    began = time.perf_counter()
    fit = RigidFit(fixed, moving, pair.bone, 1)
    halves = fit.halves(fit.whole(start))
    middle = time.perf_counter()
    two = [tuple(by_elastix(fixed, moving, pair.bone, start, seed) for seed in (1, 2))]
    ended = time.perf_counter()
    row: dict[str, object] = {"seed": seed, "noise": noise, "start_mm": off_mm(pair.bone, start, pair.foot_motion)}
    for name, found, seconds in (("ours", halves, middle - began), ("elastix", two, ended - middle)):
        row[name] = {
            "error_mm": off_mm(pair.bone, midway([one for both in found for one in both], centre), pair.foot_motion),
            "spread_mm": max(off_mm(pair.bone, *both) for both in found),
            "seconds": seconds,
        }
    return row


def noisy(image: Image, share: float, random: np.random.Generator) -> Image:
    more = share * float(np.ptp(image.values)) * random.normal(size=image.values.shape)
    return Image(image.grid, (image.values + more).astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    elastix.self_test()
    rows = []
    for seed in given.seeds:
        pair = heel_pair(seed=seed)
        for noise in (0.0, 0.05):
            rows.append(one(pair, seed, noise))
            print(rows[-1], flush=True)
    given.out.write_text(json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
