"""Gauss-Newton registration: a cubic B-spline displacement, all voxels, and a prior whose weight the images choose.

The energy is ``1/(2 s^2) sum r^2 + b/2 int c |Δ u|^2 + v/2 int (J - 1)^2 + w/2 int |E|^2``: residuals r over the voxels
of a mask with their own variance s^2, the bending of the displacement (and, very little, its distance from rest or a
first guess: `dvc.registration.gauss_newton.roughness`), the change of volume in soft tissue and the strain of the bone.
Bending counts alike everywhere (c = 1) at first; in the last steps less where the displacement is curved. Four levels
from coarse to fine, smoothed images first; each step by conjugate gradients that never form the Hessian. Nothing is
random, and every sum has a fixed order: the result is the same bit for bit on any number of threads. Reasons:
docs/decisions/0009.
"""

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.linalg import solve_banded
from scipy.ndimage import distance_transform_edt

from dvc import threads
from dvc.arguments import check_fields
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Deformation
from dvc.errors import InputError, ParameterError
from dvc.images.image import Grid, Image
from dvc.images.resample import smoothed, thinned
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.level import Level, Weights
from dvc.registration.gauss_newton.roughness import NUMBERS, Roughness

# Of each level: smoothing of both images (mm), control spacing over the finest, most steps, the step that ends it (mm).
LEVELS = ((3.2, 4.0, 8, 0.1), (1.6, 2.5, 8, 0.03), (0.8, 1.75, 5, 0.02), (0.0, 1.0, 3, 0.005))
_LEAST_VOXELS = 2.0
_BLURRED = 2.0  # standard deviations: nearer to its ends a blurred image shows what it was padded with
_RIM_MM = 1.2  # bone nearer to its surface than that may be tissue in part of a voxel
USUAL_BENDING = 3.0
"""Weight of the bending, 1/mm, that strongly loaded pairs get, about."""
USUAL_VOLUME = 300.0
"""Weight of the change of volume, 1/mm3, of tissue that keeps its volume."""
# Where the images ask for a change of volume, its gradient is held instead: while it is looked for with this weight
# over how sharply a displacement is seen (mm4), so that large voxels and small ones are judged alike; then with 1/mm.
_LOOKING_MM4, _FREED = 1000.0, 100.0
# Of voxels, mm and mm3. In larger ones, loads look like swelling (2 mm: .077 and .068 of what `volume_asked` gives).
_LONGEST_EDGE, _LARGEST = 2.5, 6.0
_RATIO = np.sqrt(10.0)
_POWERS = -4, 3  # powers of the ratio that are tried at the most: weights of 0.03 to 95
_MIDDLE = 0.7  # of each edge of the mask's box
_LAST_STEPS = 2
_DONE = (0.05, 0.12, 0.38, 0.62, 0.87)  # of the time, after each level and after the choice of the bending


@dataclass(frozen=True, slots=True)
class Parameters:
    """The spacing of the control points and the weights b, v and w of the prior, as in `dvc.GaussNewton`."""

    spacing_mm: float = 3.2
    bending: float | None = None
    volume: float | None = None
    rigidity: float = 1000.0

    def __post_init__(self) -> None:
        check_fields(self)
        if not (np.isfinite(self.spacing_mm) and self.spacing_mm > 0):
            raise ParameterError(f"The control point spacing must be above 0 mm; got {self.spacing_mm}.")
        if self.bending is not None and not (np.isfinite(self.bending) and self.bending > 0):
            raise ParameterError(f"The weight 'bending' must be above 0; got {self.bending}.")
        for name in ("volume", "rigidity"):
            weight = getattr(self, name)
            if weight is not None and not (np.isfinite(weight) and weight >= 0):
                raise ParameterError(f"The weight '{name}' must be 0 or more; got {weight}.")

    @property
    def text(self) -> str:
        """Every number that decides the result, as JSON: what an error model or a record names the engine by.

        Volume by the rule reads as volume kept, which gives the same result bit for bit unless the rule frees it
        (`Choice.frees_volume`); of a result for which it did, this text alone says too little.
        """
        rule = {"usual": USUAL_BENDING, "ratio": _RATIO, "powers": _POWERS, "steps": [1, _LAST_STEPS]}
        rims = {"blurred": _BLURRED, "bone_rim_mm": _RIM_MM}
        told = {"engine": "gauss-newton", "levels": LEVELS, "least_voxels": _LEAST_VOXELS, "rims": rims, "rule": rule}
        return json.dumps(asdict(self) | {"volume": self.weights.volume} | told | {"roughness": NUMBERS})

    @property
    def weights(self) -> Weights:
        """Weights to begin with: the usual ones where a rule decides."""
        bending = USUAL_BENDING if self.bending is None else self.bending
        return Weights(bending, USUAL_VOLUME if self.volume is None else self.volume, self.rigidity)


def fit(
    pair: AlignedPair, parameters: Parameters, start: Deformation | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[BSpline, Choice]:  # fmt: skip
    """Find the displacement, LPS mm, that carries the fixed image to the moving one.

    Where the first guess `start` (u in mm LPS) is not defined its nearest value is taken; `progress` gets the share
    that is done. Errors as in `dvc.Engine.find`.
    """
    fixed, inside = pair.fixed, pair.compared.inside
    pictures = brightness_scaled(pair)
    core = np.zeros(pair.body.grid.shape, dtype=bool)
    if pair.bone is not None:
        core = distance_transform_edt(pair.bone.inside, sampling=pair.bone.grid.spacing_mm) > _RIM_MM
    coarse = fixed.grid.spacing_mm.max() > _LONGEST_EDGE or fixed.grid.voxel_volume_mm3 > _LARGEST
    weights = parameters.weights
    choice = Choice(weights, "fixed beforehand", coarse=bool(coarse and parameters.volume is None))
    spacing = np.maximum(parameters.spacing_mm, _LEAST_VOXELS * fixed.grid.spacing_mm)
    axes, soft = np.array(fixed.grid.direction), pair.body.inside & ~core
    guess = start
    for number, (sigma_mm, factor, steps, stop_mm) in enumerate(LEVELS):
        control = control_grid(fixed.grid, factor * spacing)
        coefficients = np.zeros((3, *control.shape))
        if guess is not None:
            coefficients = turned(axes.T, spline_through(guess, control))
        rest = None if start is None else turned(axes.T, spline_through(start, control))
        level = _level(pictures, inside, soft, core, control, sigma_mm, rest)
        patience = weights.patience
        coefficients = level.descend(coefficients, weights, steps=steps * patience, stop_mm=stop_mm).coefficients
        if parameters.volume is None and number == len(LEVELS) - 2 and not choice.coarse:
            usual = replace(weights, bending=USUAL_BENDING)
            choice = replace(choice, asked=level.volume_asked(coefficients, usual, _LOOKING_MM4))
            if choice.frees_volume:
                weights = replace(weights, volume=0.0, volume_gradient=_FREED)
        guess = BSpline(control, turned(axes, coefficients))
        progress(_DONE[number])
    choice = replace(choice, weights=weights)
    level.roughness = level.following(coefficients)
    if parameters.bending is None:
        part, box = np.zeros_like(inside), pair.compared.box()  # the middle third: enough, in a third of the time
        margins = [int(0.5 * (1.0 - _MIDDLE) * (edge.stop - edge.start)) for edge in box]
        part[tuple(slice(e.start + m, e.stop - m) for e, m in zip(box, margins, strict=True))] = True
        middle = Level(pictures, inside & part, soft & part, core & part, level.roughness, rest=rest)
        choice = replace(choose(middle, coefficients, weights), asked=choice.asked, coarse=choice.coarse)
        del middle  # its memory goes to the last steps
        progress(_DONE[-1])
    steps = _LAST_STEPS * choice.weights.patience
    found = level.descend(coefficients, choice.weights, steps=steps, stop_mm=LEVELS[-1][-1])
    progress(1.0)
    return BSpline(control, turned(axes, found.coefficients)), choice


def choose(
    level: Level, coefficients: FloatArray, weights: Weights, name: str = "bending",
    powers: tuple[int, int] = _POWERS, margin: float | None = None,
) -> Choice:  # fmt: skip
    """One of the weights by two-fold cross-validation, around the value that it has.

    One half of the voxels (a chessboard of small cubes) is fitted, the other half's residual is what counts: noise that
    was fitted makes it larger, and so does detail that was smoothed away. Weights are tried in steps of a factor of 3.2
    until the best lies between two others; then the vertex of the parabola through the three, over the weight's
    logarithm. With a margin instead the weight is lowered for as long as a step takes more than a quarter of that share
    away from what is left, and then raised for as long as no more than that share is added to it.
    """
    start, usual, found = level.at(coefficients, halves=0), getattr(weights, name), dict[int, float]()
    least, greatest = powers

    def left_out(power: int) -> float:
        if power not in found:
            tried = replace(weights, **{name: usual * _RATIO**power})
            found[power] = level.lower(start, tried)[0].images.left_out
        return found[power]

    def followed(best: int, way: int, enough: float = 0.0) -> int:
        while least <= best + way <= greatest and left_out(best + way) < (1.0 - enough) * left_out(best):
            best += way
        return best

    rule = f"{name} chosen by cross-validation: fitted to half of the voxels, lowest residual in the other half"
    if margin is not None:
        best = followed(0, -1, 0.25 * margin)
        power = float(best)
        while power < greatest and left_out(int(power) + 1) <= (1.0 + margin) * min(found.values()):
            power += 1.0
        rule += f", then increased as long as the residual rises by no more than {100.0 * margin:g} %"
    else:
        best = followed(0, 1) or followed(0, -1)
        power = float(best)
        if least < best < greatest:
            below, here, above = (left_out(best + d) for d in (-1, 0, 1))
            power += 0.5 * (below - above) / max(below - 2.0 * here + above, 1e-12 * here)
            rule += ", interpolated between the weights tried"
        else:
            rule += "; the lowest residual is at the end of the range tried"
    chosen = replace(weights, **{name: float(usual * _RATIO**power)})
    return Choice(
        chosen, rule, tuple((float(usual * _RATIO**p), found[p] / min(found.values())) for p in sorted(found))
    )


def _level(
    pictures: tuple[Image, Image], inside: BoolArray, soft: BoolArray, bone: BoolArray, control: Grid, sigma_mm: float,
    rest: FloatArray | None = None,
) -> Level:  # fmt: skip
    """Images smoothed, and every so manyth voxel of them: a smooth image needs no more."""
    fixed, moving = pictures
    if sigma_mm > 0.0:
        with ThreadPoolExecutor(min(2, threads.count())) as pool:
            fixed, moving = pool.map(lambda i: thinned(smoothed(i, sigma_mm), _every(i.grid, sigma_mm)), pictures)
    every, rim_mm = _every(pictures[0].grid, sigma_mm), _BLURRED * sigma_mm
    return Level((fixed, moving), inside[every], soft[every], bone[every], Roughness(control), rim_mm, rest=rest)


def brightness_scaled(pair: AlignedPair) -> tuple[Image, Image]:
    """Both images over the brightness of the tissue in the fixed one; InputError if that is not above zero."""
    scale = float(np.nanpercentile(pair.fixed.values[pair.body.inside], 75))
    if not scale > 0:
        raise InputError(
            "The unloaded image is zero or negative in most of the tissue; intensities must be positive. Check the "
            "tissue mask (tissue), and export the magnitude image."
        )
    fixed, moving = (Image(image.grid, image.values / np.float32(scale)) for image in (pair.fixed, pair.moving))
    return fixed, moving


def _every(grid: Grid, sigma_mm: float) -> tuple[slice, ...]:
    return tuple(slice(None, None, max(1, int(sigma_mm / s + 1e-6))) for s in grid.spacing_mm)


def control_grid(grid: Grid, spacing_mm: FloatArray) -> Grid:
    """Control points along a grid's axes whose spline is defined at all of its voxels."""
    size = (np.array(grid.shape) - 1) * grid.spacing_mm
    cells = np.ceil(size / spacing_mm).astype(int) + 1
    i, j, k = (int(n) + 3 for n in cells)
    before = 0.5 * (cells * spacing_mm - size) + spacing_mm
    return Grid((i, j, k), spacing_mm, grid.points_at(-before / grid.spacing_mm), grid.direction)


def spline_through(deformation: Deformation, control: Grid) -> FloatArray:
    """Coefficients (3, mi, mj, mk), LPS mm, of the spline that has a deformation's displacement at the control points.

    Where it is not defined there, its nearest value is taken (InputError if it has none); the second difference at the
    ends is zero.
    """
    u = deformation.displacement(control.points().reshape(-1, 3)).reshape(*control.shape, 3)
    unknown = ~np.isfinite(u).all(axis=-1)
    if unknown.all():
        raise InputError(
            "The start deformation (start) is not defined anywhere in the unloaded image. Check start_frame."
        )
    if unknown.any():
        to = distance_transform_edt(unknown, sampling=control.spacing_mm, return_distances=False, return_indices=True)
        u = u[tuple(to)]
    c = np.moveaxis(u, -1, 0)
    for axis, n in enumerate(control.shape, start=1):
        bands = np.repeat([[1.0 / 6.0], [4.0 / 6.0], [1.0 / 6.0]], n, axis=1)
        bands[1, [0, -1]], bands[0, 1], bands[2, -2] = 1.0, 0.0, 0.0
        lines = np.moveaxis(c, axis, 0)
        c = np.moveaxis(solve_banded((1, 1), bands, lines.reshape(n, -1)).reshape(lines.shape), 0, axis)
    return np.ascontiguousarray(c)


def turned(rotation: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Coefficients (3, ...) of a displacement in rotated axes; sums in a fixed order, as BLAS would not do it."""
    x, y, z = coefficients
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in rotation])
