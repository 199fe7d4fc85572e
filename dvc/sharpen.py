"""Gauss-Newton registration where the tissues are known: strain may jump at their borders, and bone stays where it is.

The smooth displacement of `dvc.gaussnewton` is the start of one more stage at full resolution, for a `BorderedSpline`
u = m v + psi w. Minimised is

    1/(2 s^2) sum r^2 + b/2 int (|D^2 v|^2 + 3 L^2 |D^2 w|^2 + q |w|^2) + v/2 int (J - 1)^2 + k/2 int_skin |E|^2

with L the reach of a border and q = 0.02 / mm2; the bone has no strain by its making. Images say little about the
inside of a skin as thin as two voxels. How much it resists strain, k, is chosen as the bending is, by the residual of
voxels that were left out: what the skin does moves the fat beside it. docs/decisions/0009 has the reasons.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.borders import BorderedSpline, Borders
from dvc.bspline import BSpline
from dvc.deformation import Deformation
from dvc.descent import Level
from dvc.gaussnewton import LEVELS, Choice, GaussNewton, choose, fit, scaled, turned
from dvc.image import Image, LabelMap, Mask

_SKIN = "skin"
_SKIN_WEIGHT = 3.0  # of its strain, 1/mm3, to begin with
_SKIN_POWERS = -5, 4  # of the square root of ten, times that: 0.01 to 300
_STEPS = 3
_BENDING, _SQUARE = 3.0, 0.02  # of w beside v: times L^2, and 1/mm2


def fit_with_borders(
    fixed: Image,
    moving: Image,
    inside: Mask,
    body: Mask,
    bone: Mask | None,
    labels: LabelMap,
    options: GaussNewton,
    start: Deformation | None = None,
) -> tuple[BorderedSpline, Choice]:
    """Find the displacement that carries the fixed image to the moving one, its gradient free to jump at borders.

    Parameters
    ----------
    labels : LabelMap
        Tissues, on the grid of ``fixed``. One that is named "skin" may resist strain.
    bone : Mask or None
        Bone that does not move; without it nothing is held.

    The other parameters, and errors, are those of `dvc.gaussnewton.fit`.

    Returns
    -------
    displacement : BorderedSpline
        LPS mm.
    choice : Choice
        Its weight "rigidity" is the skin's, k.
    """
    bending = options.weights.bending
    smooth, first = fit(fixed, moving, inside, body, bone, replace(options, bending=bending), start=start)
    weights = replace(first.weights, rigidity=_SKIN_WEIGHT)
    axes, control = np.array(fixed.grid.direction), smooth.control
    borders = Borders.of(labels, bone, float(control.spacing_mm.mean()))
    soft = body.inside & (borders.own != borders.rest)
    skin = soft & np.isin(labels.labels, [number for number, name in labels.names.items() if name == _SKIN])
    scale = float(np.nanpercentile(fixed.values[body.inside], 75))
    pictures = scaled(fixed, scale), scaled(moving, scale)
    factors = borders.at_voxels()
    rough = ((1.0, 0.0), (_BENDING * borders.reach_mm**2, _SQUARE))

    def level(part: BoolArray) -> Level:
        return Level(*pictures, inside.inside & part, soft & part, skin & part, control, factors=factors, rough=rough)

    whole, slab = level(np.ones_like(soft)), level(_slab(inside.inside))
    stop_mm = LEVELS[-1][-1]
    found: FloatArray = np.concatenate([turned(axes.T, smooth.coefficients_mm), np.zeros((3, *control.shape))])
    found = whole.descend(found, weights, steps=_STEPS, stop_mm=stop_mm)
    choice, in_skin = Choice(weights, "bending fixed beforehand"), Choice(weights, "")
    if skin.any():
        in_skin = choose(slab, found, weights, "rigidity", _SKIN_POWERS)
        choice = replace(choice, weights=in_skin.weights)
    if options.bending is None:
        choice = choose(slab, found, choice.weights)
    if skin.any():
        choice = replace(choice, rule=f"{choice.rule}; in skin {in_skin.rule}", tried_in_skin=in_skin.tried)
    choice = replace(choice, asked=first.asked)
    found = whole.descend(found, choice.weights, steps=_STEPS, stop_mm=stop_mm)
    smooth, jump = (BSpline(control, turned(axes, c)) for c in np.split(found, 2))
    return BorderedSpline(smooth, jump, borders), choice


def _slab(inside: BoolArray) -> BoolArray:
    """The middle third of a mask's voxels along the first axis, from skin to skin."""
    share = np.cumsum(np.count_nonzero(inside, axis=(1, 2))) / max(np.count_nonzero(inside), 1)
    part = np.zeros_like(inside)
    part[(share > 1.0 / 3.0) & (share <= 2.0 / 3.0)] = True
    return part
