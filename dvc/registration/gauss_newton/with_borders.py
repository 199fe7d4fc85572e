"""Gauss-Newton registration where the tissues are known: strain may jump at their borders, and bone stays where it is.

The smooth displacement of `dvc.registration.gauss_newton.fit` is the start of one more stage at full resolution, for a
`BorderedSpline` u = m v + psi w. Minimised is

    1/(2 s^2) sum r^2 + b/2 int (c l^4 |Δ Δ v|^2 + 3 L^2 c l^4 |Δ Δ w|^2 + q |w|^2) + v/2 int (J - 1)^2
    + k/2 int_skin |E|^2

with L the reach of a border, q = 0.02 / mm2, and c and l as in `dvc.registration.gauss_newton.roughness`; the bone has
no strain by its making. Images say little about the inside of a skin as thin as two voxels. How much it resists strain,
k, is chosen as the bending is, by the residual of voxels that were left out: what the skin does moves the fat beside
it. docs/decisions/0009 has the reasons.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.bordered_spline import NUMBERS, BorderedSpline, Borders
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Deformation
from dvc.deformation.strain import StrainField
from dvc.errors import ParameterError
from dvc.images.image import Image, LabelMap, Mask
from dvc.registration.gauss_newton.fit import LEVELS, Choice, GaussNewton, choose, fit, scaled, turned
from dvc.registration.gauss_newton.level import Level
from dvc.registration.gauss_newton.roughness import REST

_SKIN = "skin"
USUAL_SKIN = 3.0
"""Weight of strain in the skin, 1/mm3, to begin with; between those that loaded pairs get, 0.3 to 300."""
_SKIN_POWERS = -5, 4  # of the square root of ten, times that: 0.01 to 300
_SKIN_MARGIN = 3e-4  # of the left-out residual: skin is stiff unless the images say more than that against it
_STEPS = 3
_LAPLACIANS = 2  # within a tissue; a smooth spline that has to follow jumps does it better with one
_BENDING, _SQUARE = 3.0, 0.02  # of w beside v: times L^2, and 1/mm2
_SMOOTH_SHARE = 0.4  # of the time


@dataclass(frozen=True, slots=True)
class AtBorders:
    """Parameters of the stage with borders, beside those of the engine.

    Attributes
    ----------
    skin : float or None
        Weight k of strain in the skin, 1/mm3; None: chosen for each pair by cross-validation.

    Raises
    ------
    ParameterError
        For a weight that is not above zero.
    """

    skin: float | None = None

    def __post_init__(self) -> None:
        if self.skin is not None and not (np.isfinite(self.skin) and self.skin > 0):
            raise ParameterError(f"The weight of strain in the skin must be above 0; got {self.skin}.")

    def text(self, options: GaussNewton) -> str:
        """Every number that decides the result, as JSON: the engine's, and those of its last stage."""
        stage = {
            "usual_skin": USUAL_SKIN,
            "powers": _SKIN_POWERS,
            "margin": _SKIN_MARGIN,
            "laplacians": _LAPLACIANS,
            "steps": _STEPS,
            "of_jumps": [_BENDING, _SQUARE],
            "distances": NUMBERS,
        }
        return json.dumps(json.loads(options.text) | {"borders": asdict(self) | stage})


def fit_with_borders(
    fixed: Image,
    moving: Image,
    inside: Mask,
    body: Mask,
    bone: Mask | None,
    labels: LabelMap,
    options: GaussNewton,
    at_borders: AtBorders,
    start: Deformation | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[BorderedSpline, Choice]:
    """Find the displacement that carries the fixed image to the moving one, its gradient free to jump at borders.

    Parameters
    ----------
    labels : LabelMap
        Tissues, on the grid of ``fixed``. One that is named "skin" may resist strain.
    bone : Mask or None
        Bone that does not move; without it nothing is held.
    at_borders : AtBorders

    The other parameters, and errors, are those of `dvc.registration.gauss_newton.fit.fit`.

    Returns
    -------
    displacement : BorderedSpline
        LPS mm.
    choice : Choice
        Its weight "rigidity" is the skin's, k; zero where there is no skin.
    """
    bending = options.weights.bending
    smooth, first = fit(
        fixed, moving, inside, body, bone, replace(options, bending=bending), start=start,
        progress=lambda share: progress(_SMOOTH_SHARE * share),
    )  # fmt: skip
    axes, control = np.array(fixed.grid.direction), smooth.control
    borders = Borders.of(labels, bone, float(control.spacing_mm.mean()), body)
    soft = body.inside & (borders.own != borders.rest)
    skin = soft & np.isin(labels.labels, [number for number, name in labels.names.items() if name.lower() == _SKIN])
    usual = USUAL_SKIN if at_borders.skin is None else at_borders.skin
    weights = replace(first.weights, rigidity=usual if skin.any() else 0.0)
    scale = float(np.nanpercentile(fixed.values[body.inside], 75))
    pictures = scaled(fixed, scale), scaled(moving, scale)
    factors = borders.at_voxels()
    rough = ((1.0, REST), (_BENDING * borders.reach_mm**2, _SQUARE))

    def level(part: BoolArray) -> Level:
        return Level(
            *pictures, inside.inside & part, soft & part, skin & part, control, factors=factors, rough=rough,
            laplacians=_LAPLACIANS,
        )  # fmt: skip

    part = _slab(inside.inside)
    whole, slab = level(np.ones_like(soft)), level(part)
    steps, stop_mm = _STEPS * weights.patience, LEVELS[-1][-1]
    found: FloatArray = np.concatenate([turned(axes.T, smooth.coefficients_mm), np.zeros((3, *control.shape))])
    found = whole.descend(found, weights, steps=steps, stop_mm=stop_mm)
    whole.roughness = slab.roughness = whole.following(found)
    choice = Choice(weights, "bending fixed beforehand")
    told = "fixed beforehand" if at_borders.skin is not None else "as usual, as too little of it is in the image"
    in_skin = Choice(weights, f"rigidity {told}")
    progress(_SMOOTH_SHARE + 0.1)
    if (skin & part).any() and at_borders.skin is None:
        in_skin = choose(slab, found, weights, "rigidity", _SKIN_POWERS, _SKIN_MARGIN)
        choice = replace(choice, weights=in_skin.weights)
    progress(_SMOOTH_SHARE + 0.3)
    if options.bending is None:
        choice = choose(slab, found, choice.weights)
    rule = f"{choice.rule}; in skin {in_skin.rule}" if skin.any() else choice.rule
    choice = replace(
        choice,
        rule=rule,
        tried_in_skin=in_skin.tried,
        rigidity_of=_SKIN,
        asked=first.asked,
        in_bone=None if bone is None else _moved(smooth, bone),
    )
    progress(_SMOOTH_SHARE + 0.5)
    found = whole.descend(found, choice.weights, steps=steps, stop_mm=stop_mm)
    progress(1.0)
    smooth, jump = (BSpline(control, turned(axes, c)) for c in np.split(found, 2))
    return BorderedSpline(smooth, jump, borders), choice


def _moved(smooth: BSpline, bone: Mask) -> tuple[float, float] | None:
    """Root mean square displacement (mm) and 95th percentile of the maximal shear in the bone."""
    u, H = smooth.evaluate_on_grid(bone.grid, bone.inside)
    known = np.isfinite(u).all(axis=1)
    if not known.any():
        return None
    shear = StrainField.from_gradient(H[known]).max_shear
    return float(np.sqrt((u[known] ** 2).sum(axis=1).mean())), float(np.percentile(shear, 95))


def _slab(inside: BoolArray) -> BoolArray:
    """The middle third of a mask's voxels along the first axis, from skin to skin."""
    share = np.cumsum(np.count_nonzero(inside, axis=(1, 2))) / max(np.count_nonzero(inside), 1)
    part = np.zeros_like(inside)
    part[(share > 1.0 / 3.0) & (share <= 2.0 / 3.0)] = True
    return part
