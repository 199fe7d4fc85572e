"""Does the tissue between the bone and the plate move as under a plate: towards the bone?"""

import numpy as np
from scipy.linalg import null_space

from dvc.arrays import FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.images.image import Mask
from dvc.trust.verdict import Verdict

_CELL_MM, _LAYER_MM = 3.0, 3.0
_MOST_MM, _MOST_UNKNOWN_MM = 0.5, 1.0  # where a plate is known to press, and where none is known
_LESS = 1.5  # times what moves towards the bone
_SIDES = ("left", "right"), ("posterior", "anterior"), ("superior", "inferior")


def displacement_along_normal(maps: StrainMaps, tissue: Mask, bone: Mask, normal: FloatArray) -> float:
    """Mean displacement along the plate's outward normal of the tissue nearest the plate, in the shadow of the bone.

    Parameters
    ----------
    maps : StrainMaps
        Displacement relative to the bone, reference configuration, LPS mm.
    tissue, bone : Mask
        On the grid of the maps. Only tissue within 3 mm of its outer surface counts, where the bone lies behind it.
    normal : (3,)
        Unit direction from the body to the plate, LPS.

    Returns
    -------
    float
        mm; negative where the tissue is compressed against the bone, NaN if there is no such tissue.
    """
    axes = np.column_stack([normal, null_space(normal[None])])  # with two directions in the plate
    spacing = maps.grid.spacing_mm
    sparse = tuple(slice(None, None, max(1, int(2.0 / step))) for step in spacing)
    cell_mm = max(_CELL_MM, 1.5 * float(spacing.max()))
    chosen = np.zeros(maps.grid.shape, dtype=bool)
    chosen[sparse] = (tissue.inside & maps.valid & ~bone.inside)[sparse]
    of_bone, of_tissue = bone.points() @ axes, maps.grid.points(chosen) @ axes
    along = maps.displacement_mm[chosen].astype(np.float64) @ axes[:, 0]
    if not (of_bone.size and of_tissue.size):
        return float("nan")
    lowest = of_bone[:, 1:].min(axis=0)
    cells = np.floor((of_bone[:, 1:] - lowest) / cell_mm).astype(int)
    end_of_bone = np.full(cells.max(axis=0) + 1, -np.inf)
    np.maximum.at(end_of_bone, tuple(cells.T), of_bone[:, 0])
    cells = np.floor((of_tissue[:, 1:] - lowest) / cell_mm).astype(int)
    behind = ((cells >= 0) & (cells < end_of_bone.shape)).all(axis=1)
    height, along, cells = of_tissue[behind, 0], along[behind], tuple(cells[behind].T)
    between = np.isfinite(end_of_bone[cells]) & (height > end_of_bone[cells])
    surface = np.full(end_of_bone.shape, -np.inf)
    np.maximum.at(surface, tuple(of[between] for of in cells), height[between])
    outer = between & (height > surface[cells] - _LAYER_MM)
    return float(along[outer].mean()) if outer.any() else float("nan")


def moves_away(displacement_mm: float) -> list[Verdict]:
    """A finding where the tissue under the bone moves towards the plate; none otherwise, or for NaN."""
    if not displacement_mm > _MOST_MM:
        return []
    told = (
        f"Tissue under the bone moves away from it, by {displacement_mm:.1f} mm on average along the plate normal "
        f"(limit: 'Use with care' above {_MOST_MM:g} mm); a plate presses it towards the bone. Check that the "
        "unloaded and the loaded image are not swapped, and that plate_normal points away from the body."
    )
    return [Verdict("caution", (told,))]


def moves_away_alone(maps: StrainMaps, tissue: Mask, bone: Mask) -> list[Verdict]:
    """A finding where no plate is known and tissue moves away from the bone on one side, but towards it on none.

    Parameters as in `displacement_along_normal`, for the six directions along L, P and S. Tissue that is pressed on one
    side moves towards the bone there by more than it bulges on others; in swapped images, it moves away by more.
    """
    moved = {
        name: displacement_along_normal(maps, tissue, bone, sign * axis)
        for axis, names in zip(np.eye(3), _SIDES, strict=True)
        for sign, name in zip((1.0, -1.0), names, strict=True)
    }
    known = {name: mm for name, mm in moved.items() if np.isfinite(mm)}
    if not known or max(known.values()) <= max(_MOST_UNKNOWN_MM, -_LESS * min(known.values())):
        return []
    side = max(known, key=lambda name: known[name])
    told = (
        f"Tissue moves away from the bone on its {side} side, by {known[side]:.1f} mm on average (limit: 'Use with "
        f"care' above {_MOST_UNKNOWN_MM:g} mm), and towards it on none by as much. Check that the unloaded and the "
        "loaded image are not swapped. If a plate pressed on the body, give the direction to it (plate_normal)."
    )
    return [Verdict("caution", (told,))]
