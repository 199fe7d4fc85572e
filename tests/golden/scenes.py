"""What the golden record is a record of: small inputs in ``given``, sent through the commands that users have.

Only `mrstrain`'s own functions are used, and files are given and taken: what lies inside the packages may get other
names and the record still holds.

``given`` is a study's folder. Its images are the pad below the calcaneus of `mrstrain.phantom` with seed 3 and voxels
of 1.2 mm, cut out (voxels 27:57, 47:77, 11:37, four more on each side of the images that are registered to it), a
fifth of their brightness, rounded to bytes. Its mesh is a block of 384 tetrahedra inside that pad.
"""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import nibabel
import numpy as np

import mrstrain

GIVEN = Path(__file__).parent / "given"
_LoadStep = type(inspect.signature(mrstrain.simulate).parameters["loads"].default[0])  # from the front door
_LABELS = {"labels": GIVEN / "tissues.nii.gz", "names": GIVEN / "tissues.csv", "bone_label": "bone"}
_MESH = {"mesh": GIVEN / "pad.inp"}


def phantom(folder: Path, threads: int) -> Path:
    """A small heel with its truth; that truth as `strain` writes it; the synthetic warp that it makes of the heel."""
    heel = folder / "heel"
    mrstrain.phantom(heel, seed=3, loads=["Load4"], spacing_mm=4.0, size=0.7, pad_mm=12.0)
    tissues = {"labels": heel / "tissues.nii.gz", "names": heel / "tissues.csv", "bone_label": "bone"}
    truth = heel / "truth" / "Load4" / "displacement.nii.gz"
    mrstrain.strain(heel / "Load0.nii.gz", truth, out=folder / "strain", shear_direction=(0.0, -1.0, 0.0), **tissues)
    mrstrain.twin(heel / "Load0.nii.gz", truth, out=folder / "warp", **tissues)
    return folder


def smooth(folder: Path, threads: int) -> Path:
    """Gauss-Newton with one smooth spline: the plate's axes, the mesh."""
    plate = {"shear_direction": (0.0, -1.0, 0.0)}
    return _registered(folder, threads, bone=_bone_in(folder), borders=False, **plate, **_MESH)


def at_bone(folder: Path, threads: int) -> Path:
    """Gauss-Newton with the mask of the bone alone, and so with strain that may jump at its surface; the mesh."""
    return _registered(folder, threads, bone=_bone_in(folder), **_MESH)


def interfaces(folder: Path, threads: int) -> Path:
    """Gauss-Newton with labels, and so with strain that may jump at tissue interfaces; the mesh."""
    return _registered(folder, threads, **_LABELS, **_MESH)


def elastix(folder: Path, threads: int) -> Path:
    """With parameters of elastix; labels for statistics by region alone."""
    return _registered(folder, threads, parameters=[GIVEN / "quick.txt"], **_LABELS)


def _bone_in(folder: Path) -> Path:
    """The mask of the bone, written to a folder."""
    labels = nibabel.load(GIVEN / "tissues.nii.gz")
    bone = (np.asarray(labels.dataobj) == 1).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(bone, labels.affine, labels.header), folder / "bone.nii.gz")
    return folder / "bone.nii.gz"


def _registered(folder: Path, threads: int, **options: object) -> Path:
    out = folder / "registered"
    done = mrstrain.register(
        GIVEN / "Load0.nii.gz", [GIVEN / "Load1.nii.gz"], out=out, workers=1, threads=threads, **options
    )
    assert not done.failures
    return out


def linear(folder: Path, threads: int) -> Path:
    """Normal and shear load on linear tetrahedra of two laws."""
    return _simulated(folder, threads, "P1")


def quadratic(folder: Path, threads: int) -> Path:
    """The same on quadratic tetrahedra."""
    return _simulated(folder, threads, "P2")


def _simulated(folder: Path, threads: int, element: str) -> Path:
    out = folder / "simulated"
    done = mrstrain.simulate(
        GIVEN / "pad.inp", out=out, sets=[str(GIVEN / "materials.toml")], element=element, workers=1, threads=threads,
        loads=[_LoadStep("pressed", 2.0), _LoadStep("sheared", 2.0, 1.0)],
    )  # fmt: skip
    assert done.complete
    return out


def study(folder: Path, threads: int) -> Path:
    """A study from its file to its tables, then its measurement compared once more with other options."""
    place = folder / "study"
    shutil.copytree(GIVEN, place)
    assert mrstrain.run(place, workers=1).complete
    results = place / "results"
    mrstrain.compare(
        results / "registration", [results / "models" / "akrami"], labels=place / "tissues.nii.gz",
        names=place / "tissues.csv", out=results / "compared", strains=(0.1, 0.4), on_image=True, **_MESH,
    )  # fmt: skip
    return results


SCENES: Mapping[str, Callable[[Path, int], Path]] = {
    made.__name__: made for made in (phantom, smooth, at_bone, interfaces, elastix, linear, quadratic, study)
}
"""Each makes its results in an empty folder, on so many threads, and gives the folder that they lie in."""
