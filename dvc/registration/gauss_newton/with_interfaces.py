"""Gauss-Newton registration where the tissues are known: strain is discontinuous at interfaces, and bone is rigid.

The smooth displacement of `dvc.registration.gauss_newton.fit` is the start of one more stage at full resolution, for a
`InterfaceSpline` u = m v + psi w. Its energy is

    1/(2 s^2) sum r^2 + b/2 int (c l^4 |Δ Δ v|^2 + 3 L^2 c l^4 |Δ Δ w|^2 + q |w|^2) + v/2 int (J - 1)^2
    + k/2 int_skin |E|^2

with L the reach of an interface, q = 0.02 / mm2, and c and l as in `dvc.registration.gauss_newton.roughness`; the bone
has no strain by construction. Images say little about the inside of a skin as thin as two voxels. Its resistance to
strain, k, is chosen as the bending is, by the residual of left-out voxels: the skin's motion moves the fat beside it.
Reasons: docs/decisions/0009.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dvc.arrays import FloatArray
from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import NUMBERS, Interfaces, InterfaceSpline
from dvc.deformation.protocol import Deformation
from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from dvc.images.bone_rim import NUMBERS as OF_RIM, bone_to_rim
from dvc.images.image import Grid, LabelMap, Mask
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.fit import LEVELS, Parameters, brightness_scaled, choose, fit, spline_through, turned
from dvc.registration.gauss_newton.level import Level
from dvc.registration.gauss_newton.roughness import REST, Roughness

_SKIN = "skin"
USUAL_SKIN = 3.0
"""Weight of strain in the skin, 1/mm3, to begin with; between those that loaded pairs get, 0.3 to 300."""
_SKIN_POWERS = -5, 4  # of the square root of ten, times that: 0.01 to 300
_SKIN_MARGIN = 5e-4  # of the left-out residual: skin is stiff unless the images say more than that against it
_STEPS = 3
_LAPLACIANS = 2  # within a tissue; a smooth spline that has to follow jumps does it better with one
_WITH_JUMPS = 1  # where the bone is the only tissue that is known
_LEAST_SHOWN = 0.2  # of its surface shows a rim: heels have .29 and more
_BENDING, _SQUARE = 3.0, 0.02  # of w beside v: times L^2, and 1/mm2
_SMOOTH_SHARE, _DONE = 0.3, (0.6, 0.72, 0.85)  # of the time: the smooth fit, then after each of the other steps
STAGE = {
    "usual_skin": USUAL_SKIN, "powers": _SKIN_POWERS, "margin": _SKIN_MARGIN, "laplacians": _LAPLACIANS,
    "steps": _STEPS, "of_jumps": [_BENDING, _SQUARE], "distances": NUMBERS,
}  # fmt: skip
"""Every number that decides the result of this stage, for a record."""
STAGE_AT_BONE = {
    "steps": _STEPS, "of_jumps": STAGE["of_jumps"], "distances": NUMBERS, "laplacians": _WITH_JUMPS,
    "mean_rim": OF_RIM, "least_shown": _LEAST_SHOWN,
}  # fmt: skip
"""The same where the bone is the only tissue that is known."""
NO_RIM = (
    "One smooth spline was fitted: around the mask of the bone, the unloaded image does not show the surface of the "
    "bone as the edge of a dark rim, or its slices are too thick for it. Check the mask"
)


def fit_at_bone(
    pair: AlignedPair, parameters: Parameters, start: Deformation | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[InterfaceSpline | BSpline, Choice]:  # fmt: skip
    """As `fit_with_interfaces`, with the surface of the bone as the only interface.

    The surface is moved to the outer edge of the bone's dark rim, because an interface that is off by a voxel is worse
    than none. If the image shows hardly any of that, one smooth spline is fitted instead, which the choice tells.
    """
    if pair.bone is None:
        raise InputError("A strain discontinuity at the bone needs images that are aligned on a bone mask (bone).")
    bone, shown = bone_to_rim(pair.fixed, pair.bone, pair.body)
    if shown < _LEAST_SHOWN:
        smooth, choice = fit(pair, parameters, start, progress)
        return smooth, replace(choice, rule=f"{choice.rule}. {NO_RIM}")
    return fit_with_interfaces(replace(pair, labels=None), parameters, None, start, progress, bone)


def fit_with_interfaces(
    pair: AlignedPair, parameters: Parameters, skin: float | None = None, start: Deformation | None = None,
    progress: Callable[[float], None] = lambda _: None, surface: Mask | None = None,
) -> tuple[InterfaceSpline, Choice]:  # fmt: skip
    """Find the displacement, LPS mm, that carries the fixed image to the moving one, its gradient free at interfaces.

    Interfaces are those of the pair's labels and the ``surface`` of a bone, by default the pair's. A tissue named
    "skin" may resist strain, and the bone, if there is one, does not move. The weight k of strain in the skin, 1/mm3,
    is chosen by cross-validation where it is not given; it becomes the choice's weight "rigidity", zero without skin.
    The rest is as in `dvc.registration.gauss_newton.fit.fit`.
    """
    usual = replace(parameters, bending=parameters.weights.bending)
    smooth, first = fit(pair, usual, start, lambda share: progress(_SMOOTH_SHARE * share))
    axes, control = np.array(pair.fixed.grid.direction), smooth.control
    rest = None if start is None else turned(axes.T, spline_through(start, control))
    stage = _Stage(pair, surface or pair.bone, control, rest)
    weights = replace(first.weights, rigidity=(skin or USUAL_SKIN) if stage.has_skin else 0.0)
    steps, stop_mm = _STEPS * weights.patience, LEVELS[-1][-1]
    coefficients: FloatArray = np.concatenate([turned(axes.T, smooth.coefficients_mm), np.zeros((3, *control.shape))])
    coefficients = stage.whole.descend(coefficients, weights, steps=steps, stop_mm=stop_mm).coefficients
    stage.whole.roughness = stage.slab.roughness = stage.whole.following(coefficients)
    progress(_DONE[0])
    if skin is not None:
        in_skin = Choice(weights, "rigidity fixed beforehand")
    elif stage.slab_has_skin:
        in_skin = choose(stage.slab, coefficients, weights, "rigidity", _SKIN_POWERS, _SKIN_MARGIN)
    else:
        in_skin = Choice(weights, "the weight is at its default, because the image shows too little skin")
    progress(_DONE[1])
    choice = Choice(in_skin.weights, "bending fixed beforehand")
    if parameters.bending is None:
        choice = choose(stage.slab, coefficients, in_skin.weights)
    in_words = in_skin.rule.replace("rigidity", "the weight of its strain")
    rule = f"{choice.rule}. In skin, {in_words}" if stage.has_skin else choice.rule
    in_bone = None if pair.bone is None else _moved(smooth, pair.bone)
    choice = replace(
        choice, rule=rule, tried_in_skin=in_skin.tried, at_interfaces=True, asked=first.asked, coarse=first.coarse,
        in_bone=in_bone,
    )  # fmt: skip
    progress(_DONE[2])
    del stage.slab  # its memory goes to the last steps
    found = stage.whole.descend(coefficients, choice.weights, steps=steps, stop_mm=stop_mm)
    progress(1.0)
    v, w = (BSpline(control, turned(axes, part)) for part in np.split(found.coefficients, 2))
    return InterfaceSpline(v, w, stage.interfaces), choice


class _Stage:
    """The last stage at full resolution: in the whole body, and in a slab of it in which weights are chosen."""

    def __init__(self, pair: AlignedPair, bone: Mask | None, control: Grid, rest: FloatArray | None) -> None:
        inside = pair.compared.inside
        labels = pair.labels or LabelMap(pair.fixed.grid, np.ones(inside.shape, dtype=int), {1: "tissue"})
        self.interfaces = Interfaces.of(labels, bone, float(control.spacing_mm.mean()), pair.body)
        soft = pair.body.inside & (self.interfaces.own != self.interfaces.rest)
        named = [number for number, name in labels.names.items() if name.lower() == _SKIN]
        skin = soft & np.isin(labels.labels, named)
        pictures = brightness_scaled(pair)
        rough = ((1.0, REST), (_BENDING * self.interfaces.reach_mm**2, _SQUARE))
        laplacians = _WITH_JUMPS if pair.labels is None else _LAPLACIANS
        roughness = Roughness(control, rough, laplacians)
        both = None if rest is None else np.concatenate([rest, np.zeros_like(rest)])
        share = np.cumsum(np.count_nonzero(inside, axis=(1, 2))) / max(np.count_nonzero(inside), 1)
        slab = np.zeros_like(inside)  # the middle third of the voxels along the first axis, from skin to skin
        slab[(share > 1.0 / 3.0) & (share <= 2.0 / 3.0)] = True
        self.whole, self.slab = (
            Level(pictures, inside & part, soft & part, skin & part, roughness, interfaces=self.interfaces, rest=both)
            for part in (np.ones_like(soft), slab)
        )
        self.has_skin, self.slab_has_skin = bool(skin.any()), bool((skin & slab).any())


def _moved(smooth: BSpline, bone: Mask) -> tuple[float, float] | None:
    """Root mean square displacement (mm) and 95th percentile of the maximum shear in the bone."""
    u, H = smooth.evaluate_on_grid(bone.grid, bone.inside)
    known = np.isfinite(u).all(axis=1)
    if not known.any():
        return None
    shear = StrainField.from_gradient(H[known]).max_shear
    return float(np.sqrt((u[known] ** 2).sum(axis=1).mean())), float(np.percentile(shear, 95))
