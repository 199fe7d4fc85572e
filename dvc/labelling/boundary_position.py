"""How far a boundary of a tissue may be from its place, from the probability of the tissue.

If the position of a boundary has a normal distribution with the standard deviation s, the probability of the tissue
beside it is p = Phi(x / s), x being the distance from the mean position. Across the boundary, the integral of p (1 - p)
is s / sqrt(pi), and that of the gradient of p is 1. Integrated over a volume, the latter is the area of the boundary.
"""

import numpy as np
from scipy import ndimage

from dvc.images.bone_names import is_bones_name
from dvc.labelling.tissues import TissueLabels


def position_sd_mm(found: TissueLabels) -> dict[str, float]:
    """Standard deviation (mm) of the position of the boundary between a soft tissue and the others, by tissue.

    Parameters
    ----------
    found : TissueLabels
        Labels with the probability of each tissue. Only voxels whose neighbours are all soft tissue count, so that
        boundaries with air and bone do not. A tissue without a boundary with others is left out.
    """
    names = found.labels.names
    soft = {number: name for number, name in names.items() if not is_bones_name(name)}
    inside = ndimage.binary_erosion(np.isin(found.labels.labels, [*soft]))
    told = {}
    for number, probability in zip(names, found.probability, strict=True):
        slope = np.gradient(probability, *found.labels.grid.spacing_mm)
        crossed = float(np.sqrt(np.sum(np.square(slope), axis=0))[inside].sum(dtype=np.float64))
        if number in soft and crossed > 0.0:
            here = probability[inside].astype(np.float64)
            told[soft[number]] = float(np.sqrt(np.pi) * (here * (1.0 - here)).sum() / crossed)
    return told
