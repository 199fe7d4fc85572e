"""SPAM: local correlation of windows, passed on from large windows to small ones."""

import numpy as np
import spam.DIC
from exchange import arguments, extrapolated, read_array, write_nodes
from scipy.ndimage import gaussian_filter, median_filter

# Half-window, voxels between nodes, smoothing of the images (voxels), by pass.
PASSES = ((14, 8, 2.0), (9, 6, 1.0), (6, 4, 0.5))
OUTLIER_VOXELS = 1.0
COVERAGE = 0.3
CONVERGED = 2


def main() -> None:
    folder, threads = arguments()
    # Its arrays and coordinates are (z, y, x).
    reference, aligned, mask = (
        read_array(folder / f"{name}.mha").T.astype(np.float32) for name in ("reference", "aligned", "mask")
    )
    coarse = None
    for half, step, blur in PASSES:
        nodes, counts = spam.DIC.makeGrid(reference.shape, step)
        start = None
        if coarse is not None:
            start = spam.DIC.interpolatePhiField(*coarse, nodes, nNeighbours=8, interpolateF="no", nProcesses=threads)
        found, status, *_ = spam.DIC.ldic(
            gaussian_filter(reference, blur),
            gaussian_filter(aligned, blur),
            nodes,
            np.array([half] * 3),
            processes=threads,
            im1mask=mask > 0,
            PhiField=start,
            margin=[-10, 10] * 3 if coarse is None else [-4, 4] * 3,
            maskCoverage=COVERAGE,
            updateGradient=coarse is not None,
        )
        u = np.where(status == CONVERGED, found[:, :3, 3].T, np.nan).reshape(3, *counts)
        good = np.isfinite(u).all(axis=0) & (_from_neighbours(u) < OUTLIER_VOXELS)
        print("nodes kept", int(good.sum()), "of", int((status > -5).sum()))
        coarse = nodes[good.ravel()], found[good.ravel()]
    u[:, ~good] = np.nan
    write_nodes(folder, extrapolated(u[::-1].T), [step] * 3, [step] * 3)


def _from_neighbours(u: np.ndarray) -> np.ndarray:
    """Distance (voxels) of each node's displacement from the median of those around it."""
    known = np.isfinite(u).all(axis=0)
    filled = extrapolated(u.transpose(1, 2, 3, 0)) if known.any() else u.transpose(1, 2, 3, 0)
    around = np.stack([median_filter(filled[..., c], 3) for c in range(3)])
    return np.linalg.norm(u - around, axis=0)


if __name__ == "__main__":
    main()
