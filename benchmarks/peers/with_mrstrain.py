"""mrstrain by its own engine or a preset: the scans as acquired, body and bone; the foot's motion it finds for itself.

By the engine that knows borders it gets the label map as well.

Runs in mrstrain's environment, as ``python -m benchmarks.peers.with_mrstrain FOLDER THREADS NAME``.
"""

from __future__ import annotations

import sys
from pathlib import Path

from dvc import BSpline, Mask, Settings, read_image, read_labels, register
from dvc.io.transforms.interface_spline import write_interface_spline
from dvc.io.transforms.write import write_elastix_transform


def main() -> None:
    folder, threads = Path(sys.argv[1]), int(sys.argv[2])
    reference, loaded = read_image(folder / "scan0.mha"), read_image(folder / "scan1.mha")
    bone, body = (
        Mask(mask.grid, mask.values > 0) for mask in (read_image(folder / f"{name}.mha") for name in ("bone", "body"))
    )
    settings = Settings.of(sys.argv[3], threads=threads)
    labels = read_labels(folder / "labels.mha", folder / "labels.csv") if settings.engine.needs_labels else None
    found = register(reference, loaded, bone=bone, tissue=body, labels=labels, settings=settings)
    if isinstance(found.displacement, BSpline):
        write_elastix_transform(folder, found.displacement, None, reference.grid)[0].rename(folder / "found.txt")
    else:
        write_interface_spline(folder / "found.npz", found.displacement)


if __name__ == "__main__":
    main()
