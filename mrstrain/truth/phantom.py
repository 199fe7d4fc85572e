"""`phantom`: images of a synthetic heel under Load0 to Load4, with the truth in the layout of `register`'s results."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc import Grid, Image, LabelMap, Mask, RigidMotion, StrainMaps, strain_maps, write_image, write_labels, write_mask
from dvc.atomic_files import whole_folder, write_json
from dvc.deformation.protocol import Motion
from dvc.errors import InputError
from dvc.file_names import as_typed
from dvc.io.result_folder import PROVENANCE, REGIONS, write_maps
from dvc.trust.regions import region_statistics, write_regions_csv
from mrstrain.options.door import door
from mrstrain.options.modelling import HeelShape
from mrstrain.records.durations import phantom_images
from mrstrain.records.inputs import alone, output_folder, refuse_small_disk
from mrstrain.records.progress import OnProgress, expect
from mrstrain.records.provenance import provenance
from mrstrain.records.time_left import Expected
from phantoms import LOADS, Heel, covering, heel_grid, labels_of, labels_to_mesh, random_foot_motion, scan, under_load

TRUTH = "truth"
"""Folder of the true fields, with one for each load."""

_BYTES_PER_VOXEL = 12  # measured: files of one load, image and truth
_REPEAT = 100  # acquisition number of the repeat scan
_CASE, _AGAIN = "phantom", "Load0-again"
_OF_IMAGE = 0.65  # of the time of a load, its image; the other part is the truth
_Motions = Mapping[str, Motion]
_Record = dict[str, object]


@dataclass(frozen=True, slots=True)
class PhantomFiles:
    """What `phantom` wrote: the folder, and its images by name."""

    out: Path
    images: dict[str, Path]

    def summary(self) -> list[str]:
        """Summary, with the command that registers the images."""
        at = self.out
        loads = " ".join(as_typed(path) for name, path in self.images.items() if name in LOADS)
        return [
            f"Images: {', '.join(path.name for path in self.images.values())}; truth: {at / TRUTH}",
            "To register them:",
            f"mrstrain register {as_typed(self.images['Load0'])} {loads} "
            f"--bone {as_typed(at / 'calcaneus.nii.gz')} --labels {as_typed(at / 'tissues.nii.gz')} "
            f"--names {as_typed(at / 'tissues.csv')} --repeat {as_typed(self.images[_AGAIN])} "
            f"--out {as_typed(at / 'results')}",
        ]


@door
def phantom(
    out: Path | str, *, seed: int = 1, loads: Sequence[str] = tuple(LOADS), spacing_mm: float | Sequence[float] = 0.8,
    snr: float | None = 25.0, progress: OnProgress | None = None, shape: HeelShape,
) -> PhantomFiles:  # fmt: skip
    """Make images of a synthetic heel, unloaded and loaded, with exactly known strain.

    Parameters
    ----------
    out : path
        Gets ``Load0.nii.gz``, ``Load0-again.nii.gz`` (a repeat scan), an image of each load, ``calcaneus.nii.gz``,
        ``tissues.nii.gz`` and ``tissues_to_mesh.nii.gz`` with their names, ``phantom.json``, and ``truth/LOAD`` with
        displacement and strain as `register` writes them.
    seed : int
        Of shapes, textures, noise, bias fields and foot motion.
    loads : names out of Load1, Load2, Load3, Load4
    spacing_mm : one length or three
        Voxel size, mm; 0.3 to 4.
    snr : float or None
        Signal of fat over the standard deviation of the noise; None for images without noise.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If a number is out of its range or a load is unknown.
    OutputError
        If the folder cannot be written to, or the disk has too little room.
    """
    heel = Heel(seed, **dict(shape))
    grid = heel_grid(spacing_mm, heel.size)
    if snr is not None and not 1.0 <= snr <= 1000.0:
        raise InputError(f"The SNR (snr) must be between 1 and 1000, or None for no noise; got {snr}.")
    motions = {load: under_load(heel, load) for load in loads}
    if not motions:
        raise InputError(f"Give at least one load: {', '.join(LOADS)}.")
    target = Path(out)
    needed = _BYTES_PER_VOXEL * int(np.prod(grid.shape)) * (len(motions) + 2)
    refuse_small_disk(target, needed, "the images need", ", larger voxels or fewer loads")
    parameters = {"seed": seed, "spacing_mm": np.broadcast_to(spacing_mm, 3).tolist(), "snr": snr, **shape.plain()}
    parameters["loads_press_shear_slide_mm"] = {load: LOADS[load] for load in motions}
    record = provenance("phantom", {}, parameters)
    with output_folder(target), alone(target):
        images = _write_images(target, heel, grid, snr, motions, record, progress or (lambda *_: None))
        write_json(target / "phantom.json", record)
    return PhantomFiles(target, images)


def _write_images(
    target: Path, heel: Heel, grid: Grid, snr: float | None, motions: _Motions, record: _Record, progress: OnProgress
) -> dict[str, Path]:
    """Write all images and the truth; return paths of the images by name. ``record`` gets the foot's rigid motions."""
    labels = labels_of(heel, grid)
    bone, body = labels.region("bone"), Mask(grid, labels.labels > 0)
    images: dict[str, Path] = {}
    foot_motions: dict[str, RigidMotion] = {}
    writes: list[Future[None]] = []
    acquisitions = {_AGAIN: _REPEAT} | {load: 1 + list(LOADS).index(load) for load in motions}
    how_long = phantom_images(("Load0", _AGAIN), motions, float(np.prod(grid.shape)))
    expect(progress, {_CASE: Expected(how_long.seconds)})

    def told(name: str, done: float) -> None:
        progress(_CASE, "images and truth", how_long.share(name, done))

    # Files are compressed in one thread while the next image is formed here.
    with ThreadPoolExecutor(1) as pool:

        def write(name: str, image: Image) -> None:
            images[name] = target / f"{name}.nii.gz"
            writes.append(pool.submit(write_image, images[name], image))

        told("Load0", 0.0)
        write("Load0", scan(heel, grid, snr=snr, number=0))
        writes.append(pool.submit(write_mask, target / "calcaneus.nii.gz", bone))
        writes.append(pool.submit(write_labels, target / "tissues.nii.gz", labels))
        writes.append(pool.submit(write_labels, target / "tissues_to_mesh.nii.gz", labels_to_mesh(heel, labels)))
        for name, number in acquisitions.items():
            foot = foot_motions[name] = random_foot_motion(heel.seed, number)
            loaded_grid = covering(grid, foot.apply(bone.points()))
            told(name, 0.0)
            write(name, scan(heel, loaded_grid, motions.get(name), foot, snr=snr, number=number))
            if name in motions:
                told(name, _OF_IMAGE)
                maps = strain_maps(motions[name], body)
                writes.append(pool.submit(_write_truth, target / TRUTH / name, maps, labels, record))
        for done in writes:
            done.result()
    progress(_CASE, "images and truth", 1.0)
    record["foot_motion"] = {
        name: {"rotation": m.rotation.tolist(), "translation_lps_mm": m.translation_mm.tolist()}
        for name, m in foot_motions.items()
    }
    return images


def _write_truth(folder: Path, maps: StrainMaps, labels: LabelMap, record: dict[str, object]) -> None:
    folder.parent.mkdir(exist_ok=True)
    with whole_folder(folder) as partial:
        write_maps(partial, maps)
        write_regions_csv(partial / REGIONS, region_statistics(labels, maps.by_quantity))
        write_json(partial / PROVENANCE, record)
