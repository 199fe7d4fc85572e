"""How far a boundary of a tissue may be from its place, from the probability of the tissue.

If the position of a boundary has a normal distribution with the standard deviation s, the probability of the tissue
beside it is p = Phi(x / s), x being the distance from the mean position. Across the boundary, the integral of p (1 - p)
is s / sqrt(pi), and that of the gradient of p is 1. Integrated over a volume, the latter is the area of the boundary.
Only voxels near the boundary count: elsewhere, a small probability of another tissue says nothing about its position.
"""

import numpy as np
from scipy import ndimage

from dvc.images.bone_names import is_bones_name
from dvc.labelling.tissues import TissueLabels

_NEAR_MM = 2.5
_MOST_VOXELS = 2.0  # of the longest edge; a boundary that may be anywhere has no position


def position_sd_mm(found: TissueLabels) -> dict[str, float]:
    """Standard deviation (mm) of the position of the boundary between a soft tissue and the others, by tissue.

    Parameters
    ----------
    found : TissueLabels
        Labels with the probability of each tissue. Only voxels within 2.5 mm of the boundary of a label count whose
        neighbours are all soft tissue, so that boundaries with air and bone do not. A tissue without a boundary with
        others is left out; the largest value is two voxel edges.
    """
    names = found.labels.names
    soft = {number: name for number, name in names.items() if not is_bones_name(name)}
    inside = ndimage.binary_erosion(np.isin(found.labels.labels, [*soft]))
    edges, told = found.labels.grid.spacing_mm, {}
    for number, probability in zip(names, found.probability, strict=True):
        own = found.labels.labels == number
        if number not in soft or not own.any() or own.all():
            continue
        beyond = ndimage.distance_transform_edt(own, edges) + ndimage.distance_transform_edt(~own, edges)
        near = inside & (beyond <= _NEAR_MM + 0.5 * edges.min())
        slope = np.sqrt(np.sum(np.square(np.gradient(probability, *edges)), axis=0))
        crossed = float(slope[near].sum(dtype=np.float64))
        if crossed > 0.0:
            here = probability[near].astype(np.float64)
            sd_mm = float(np.sqrt(np.pi) * (here * (1.0 - here)).sum() / crossed)
            told[soft[number]] = min(sd_mm, _MOST_VOXELS * float(edges.max()))
    return told
