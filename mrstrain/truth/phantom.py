"""`phantom`: images of a synthetic heel under Load0 to Load4, with the truth as `register` writes results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.atomic_files import whole_folder, write_json
from dvc.deformation.protocol import RigidMotion
from dvc.deformation.strain_maps import StrainMaps, strain_maps
from dvc.errors import InputError
from dvc.images.image import Image, LabelMap, Mask
from dvc.io.images.write import write_image, write_labels, write_mask
from dvc.io.result_folder import PROVENANCE, REGIONS, write_maps
from dvc.trust.regions import region_statistics, write_regions_csv
from mrstrain.records.inputs import make_output, refuse_small_disk
from mrstrain.records.provenance import provenance
from phantoms.anatomy import Heel
from phantoms.heel import (
    LOADS,
    covering,
    drawn_motion,
    heel_grid,
    labels_of,
    labels_to_mesh,
    scan,
    under_load,
)

Told = Callable[[str, str, float], None]

_BYTES_PER_VOXEL = 12  # of the files of one load, images and truth, as measured
_STAGE = "images and truth"
_AGAIN = 100  # number of the repeat scan's acquisition


@dataclass(frozen=True, slots=True)
class PhantomSet:
    """What `phantom` wrote: the folder, and its images by name."""

    out: Path
    images: dict[str, Path]

    def summary(self) -> list[str]:
        """A few lines for a person, with the command that registers the set."""
        at = self.out
        loads = " ".join(str(path) for name, path in self.images.items() if name in LOADS)
        return [
            f"Images: {', '.join(path.name for path in self.images.values())}; truth: {at / 'truth'}",
            f"To register them: mrstrain register {self.images['Load0']} {loads} --bone {at / 'calcaneus.nii.gz'} "
            f"--labels {at / 'tissues.nii.gz'} --names {at / 'tissues.csv'} "
            f"--repeat {self.images['Load0-again']} --out {at / 'results'}",
        ]


def phantom(
    out: Path | str,
    *,
    seed: int = 1,
    loads: Sequence[str] = tuple(LOADS),
    spacing_mm: float | Sequence[float] = 0.8,
    snr: float | None = 25.0,
    size: float = 1.0,
    pad_mm: float = 18.0,
    skin_mm: float = 2.0,
    lobule_mm: float = 6.0,
    progress: Told | None = None,
) -> PhantomSet:
    """Make a synthetic heel's images without load and under loads, with exactly known strain.

    Parameters
    ----------
    out : path
        Gets ``Load0.nii.gz``, ``Load0-again.nii.gz`` (a repeat scan), an image of each load, ``calcaneus.nii.gz``,
        ``tissues.nii.gz`` and ``tissues_to_mesh.nii.gz`` with their names, ``phantom.json``, and ``truth/LOAD`` with
        displacement and strain as `register` writes them.
    seed : int
        Of shapes, textures, noise, sensitivities and the foot's motions.
    loads : names out of Load1, Load2, Load3, Load4
    spacing_mm : one length or three
        Of the voxels, mm; 0.3 to 4.
    snr : float or None
        Fat's signal over the noise's standard deviation; None for no noise.
    size, pad_mm, skin_mm, lobule_mm : float
        Of the heel; see `phantoms.anatomy.Heel`.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Returns
    -------
    PhantomSet

    Raises
    ------
    InputError
        For a number out of its range or an unknown load.
    OutputError
        If the folder cannot be written to, or the disk has too little room.
    """
    heel = Heel(seed, size=size, pad_mm=pad_mm, skin_mm=skin_mm, lobule_mm=lobule_mm)
    grid = heel_grid(spacing_mm, size)
    if snr is not None and not 1.0 <= snr <= 1000.0:
        raise InputError(
            f"The SNR must lie between 1 and 1000; got {snr}; or None (--no-noise) for images without noise."
        )
    motions = {load: under_load(heel, load) for load in loads}
    if not motions:
        raise InputError(f"Name at least one load out of {', '.join(LOADS)}.")
    target = Path(out)
    needed = _BYTES_PER_VOXEL * int(np.prod(grid.shape)) * (len(motions) + 2)
    refuse_small_disk(target, needed, "the set needs", ", larger voxels or fewer loads")
    make_output(target)
    tell = progress or (lambda *_: None)
    steps, done = 2 + 2 * len(motions), 0

    def step() -> None:
        nonlocal done
        tell("phantom", _STAGE, done / steps)
        done += 1

    record = provenance(
        "phantom",
        {},
        {
            "seed": seed,
            "spacing_mm": np.broadcast_to(spacing_mm, 3).tolist(),
            "snr": snr,
            "size": size,
            "pad_mm": pad_mm,
            "skin_mm": skin_mm,
            "lobule_mm": lobule_mm,
            "loads_press_shear_slide_mm": {load: LOADS[load] for load in motions},
        },
    )
    labels = labels_of(heel, grid)
    bone = labels.region("bone")
    body = Mask(grid, labels.labels > 0)
    images: dict[str, Path] = {}
    moved: dict[str, RigidMotion] = {}
    writing: list[Future[None]] = []
    # Files are packed in one thread while the next image is formed here.
    with ThreadPoolExecutor(1) as pool:

        def keep(name: str, image: Image) -> None:
            images[name] = target / f"{name}.nii.gz"
            writing.append(pool.submit(write_image, images[name], image))

        step()
        keep("Load0", scan(heel, grid, snr=snr, number=0))
        writing.append(pool.submit(write_mask, target / "calcaneus.nii.gz", bone))
        writing.append(pool.submit(write_labels, target / "tissues.nii.gz", labels))
        writing.append(pool.submit(write_labels, target / "tissues_to_mesh.nii.gz", labels_to_mesh(heel, labels)))
        acquisitions = {"Load0-again": _AGAIN} | {load: 1 + list(LOADS).index(load) for load in motions}
        for name, number in acquisitions.items():
            foot = moved[name] = drawn_motion(seed, number)
            where = covering(grid, foot.apply(bone.points()))
            step()
            keep(name, scan(heel, where, motions.get(name), foot, snr=snr, number=number))
            if name in motions:
                step()
                maps = strain_maps(motions[name], body)
                writing.append(pool.submit(_write_truth, target / "truth" / name, maps, labels, record))
        for file in writing:
            file.result()
    record["foot_motion"] = {
        name: {"rotation": m.rotation.tolist(), "translation_lps_mm": m.translation_mm.tolist()}
        for name, m in moved.items()
    }
    write_json(target / "phantom.json", record)
    tell("phantom", _STAGE, 1.0)
    return PhantomSet(target, images)


def _write_truth(folder: Path, maps: StrainMaps, labels: LabelMap, record: dict[str, object]) -> None:
    folder.parent.mkdir(exist_ok=True)
    with whole_folder(folder) as partial:
        write_maps(partial, maps)
        write_regions_csv(partial / REGIONS, region_statistics(labels, maps.by_quantity))
        write_json(partial / PROVENANCE, record)
