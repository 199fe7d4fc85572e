"""pyxel: finite-element correlation on linear tetrahedra, regularised by a Laplacian, from coarse images to fine."""

import itertools

import numpy as np
import pyxel
from exchange import arguments, extrapolated, read_array, write_nodes
from scipy.ndimage import binary_dilation

ELEMENT = 4  # voxels
START_LENGTH, LENGTH = 12.0, 6.0  # of the regularisation, voxels: on binned images (times the bin), on full ones
SCALES = [2, 1]  # images binned by 2^n, before the full ones


def main() -> None:
    folder, _ = arguments()  # threads come from the environment
    reference, aligned, mask = (read_array(folder / f"{name}.mha") for name in ("reference", "aligned", "mask"))
    counts = [n // ELEMENT for n in mask.shape]
    mesh = pyxel.Mesh({4: _tetrahedra(mask > 0, counts)}, _lattice(counts) * float(ELEMENT), 3)
    mesh.RemoveUnusedNodes()
    mesh.Connectivity()
    camera = pyxel.CameraVol([1, 0, 0, 0, 0, 0, 0])
    f, g = _volume(reference), _volume(aligned)
    U = pyxel.MultiscaleInit(f, g, mesh, camera, scales=SCALES, l0=START_LENGTH)
    mesh.DVCIntegrationTetVoxel(f, camera)
    f.BuildInterp()
    g.BuildInterp()
    U, _ = pyxel.Correlate(f, g, mesh, camera, U0=U, l0=LENGTH, L=mesh.Laplacian(), direct=True)
    u = np.full((*counts, 3), np.nan)
    u[tuple(np.rint(mesh.n / ELEMENT).astype(int).T)] = U[mesh.conn]
    write_nodes(folder, extrapolated(u), [0, 0, 0], [ELEMENT] * 3)


def _volume(values: np.ndarray) -> pyxel.Volume:
    volume = pyxel.Volume("")
    volume.pix = values.astype(float)
    return volume


def _lattice(counts: list[int]) -> np.ndarray:
    return np.moveaxis(np.indices(counts), 0, -1).reshape(-1, 3)


def _tetrahedra(body: np.ndarray, counts: list[int]) -> np.ndarray:
    """Six tetrahedra in each cube of the lattice that has a voxel of the body; (n, 4) node numbers."""
    used = binary_dilation(body)
    corners = _lattice([n - 1 for n in counts])
    reach = np.minimum(corners * ELEMENT + ELEMENT + 1, body.shape)
    boxes = [tuple(map(slice, low, high)) for low, high in zip(corners * ELEMENT, reach, strict=True)]
    cubes = corners[[bool(used[box].any()) for box in boxes]]
    paths = []
    for order in itertools.permutations(range(3)):
        steps = np.vstack([np.zeros(3, int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        if np.linalg.det(np.eye(3)[list(order)]) < 0:  # the same handedness for all
            steps[[1, 2]] = steps[[2, 1]]
        paths.append(steps)
    at = cubes[:, None, None, :] + np.array(paths)[None]
    return np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), counts).reshape(-1, 4)


if __name__ == "__main__":
    main()
