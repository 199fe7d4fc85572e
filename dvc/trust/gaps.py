"""Where error bars are known to hold fewer than 90 % of the true values: none are given there, with the reason."""

from dataclasses import replace

import numpy as np

from dvc.arrays import BoolArray
from dvc.trust.components import ComponentUncertainty
from dvc.trust.uncertainty import Uncertainty

_SKIN, _TENDON = "skin", "tendon"
_NO_INTERFACES = "gauss-newton", "gauss-newton-bone"  # at the skin
_OF_SKIN = (
    "No standard uncertainty of the max. shear in skin: without strain discontinuities at tissue interfaces, it "
    "covered only 80 to 83 % of the voxels where the fat pad slides."
)
_OF_TENDON = (
    "No standard uncertainty of displacement and strain components in tendon: under single motions, it covered as few "
    "as 78 % of the voxels."
)
_OF_MADE_SKIN = (
    "No intervals in skin: on phantoms whose fat pad slides, with a label map made from the image, they contained "
    "only 60 to 80 % of the true statistics."
)


def without_gaps(known: Uncertainty, engine: str, *, labels_from_image: bool) -> tuple[Uncertainty, tuple[str, ...]]:
    """Uncertainty with NaN where its coverage is known to be too low, and the reasons.

    The coverage was observed on phantoms (benchmarks: Coverage on unseen motions, Coverage with labels made from the
    image). Only conditions that a measurement shows are known here: its tissues, its engine and the origin of its label
    map. Whether tissue slides is not among them.
    """
    reasons = []
    skin, tendon = (
        {name: inside for name, inside in known.regions.items() if name.lower() == of} for of in (_SKIN, _TENDON)
    )
    if skin and engine in _NO_INTERFACES:
        known = replace(known, sigma=np.where(_any(skin), np.float32(np.nan), known.sigma))
        reasons.append(_OF_SKIN)
    if tendon and known.components is not None:
        known = replace(known, components=_blank(known.components, tendon))
        reasons.append(_OF_TENDON)
    if skin and labels_from_image:
        kept = (replace(i, low=np.nan, high=np.nan) if i.region in skin else i for i in known.intervals)
        known = replace(known, intervals=tuple(kept))
        reasons.append(_OF_MADE_SKIN)
    return known, tuple(reasons)


def _any(regions: dict[str, BoolArray]) -> BoolArray:
    return np.asarray(np.any(list(regions.values()), axis=0))


def _blank(of: ComponentUncertainty, regions: dict[str, BoolArray]) -> ComponentUncertainty:
    """Components without uncertainty in some regions; their means and biases stay."""
    inside, unknown = _any(regions), np.float32(np.nan)
    normal, shear, displacement = (
        np.where(inside, unknown, sigma) for sigma in (of.normal_strain, of.shear_strain, of.displacement_mm)
    )
    rows = (
        replace(row, voxel_standard_uncertainty=np.nan, voxel_expanded_uncertainty=np.nan)
        if row.region in regions
        else row
        for row in of.rows
    )
    return replace(of, normal_strain=normal, shear_strain=shear, displacement_mm=displacement, rows=tuple(rows))
