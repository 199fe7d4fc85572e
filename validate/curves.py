"""Strain intensity: strain-volume curves, and the area between two of them.

V(s) is the volume of the cells whose maximum shear strain exceeds s: an exact step function, without bins. The metric
is A = integral of |V_FE - V_DVC| ds over a range of strain, in mL: the area validation metric (Ferson, Oberkampf and
Ginzburg 2008) with volume in place of probability. The normalised area, A over the tissue's volume and the width of
the range, is dimensionless.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.trust.regions import volume_above
from dvc.trust.uncertainty import widened
from validate.extrapolation import LEVELLED
from validate.sensitivity import Sensitivity

RANGE = (0.2, 0.5)
"""Range of maximum shear strain over which curves are compared by default."""

MOST_STRAIN = 3.0
"""Largest upper end of a range; larger values are probably in percent."""

DRAWS = 200
"""Number of true fields drawn from the error model for the curves and areas of a load."""

_GRID = 301
_UNSURE, _SURE = 0.025, 0.975
_EVERY = 4  # every so many draws, one serves as a perfect model


def check_range(strains: tuple[float, float]) -> None:
    """InputError unless a range of maximum shear strain increases and lies within 0 to 3."""
    if not 0.0 <= strains[0] < strains[1] <= MOST_STRAIN:
        raise InputError(
            f"The range of strain must increase and lie within 0 to {MOST_STRAIN:g} (not in percent); got "
            f"{strains[0]:g} to {strains[1]:g}."
        )


def range_told(strains: tuple[float, float]) -> str:
    """The range of maximum shear strain of an area, in words."""
    return f"max. shear {strains[0]:g} to {strains[1]:g}"


def area_between(
    first: FloatArray, second: FloatArray, volumes_ml: FloatArray, strains: tuple[float, float] = RANGE
) -> float:
    """Area (mL) between the strain-volume curves of two fields (n,) on the same cells; exact.

    Examples
    --------
    >>> two = np.array([1.0, 1.0])
    >>> round(area_between(np.array([0.3, 0.6]), np.array([0.4, 0.6]), two), 12)
    0.1
    >>> round(area_between(np.array([0.1, 0.6]), np.array([0.9, 0.6]), two, (0.2, 0.5)), 12)
    0.3
    """
    low, high = strains
    jumps = np.concatenate([first, second])
    edges = np.unique(np.concatenate([[low, high], jumps[(jumps > low) & (jumps < high)]]))
    between = volume_above(first, volumes_ml, edges[:-1]) - volume_above(second, volumes_ml, edges[:-1])
    return float(np.abs(between) @ np.diff(edges))


def area_to(
    shear: FloatArray, volumes_ml: FloatArray, strains: tuple[float, float], at: FloatArray, curve_ml: FloatArray
) -> float:
    """Area (mL) between the strain-volume curve of a field (n,) and a curve that is given at strains ``at`` (k,)."""
    inner = np.linspace(*strains, _GRID)
    between = _above(shear, volumes_ml, inner) - np.interp(inner, at, curve_ml)
    return float(np.trapezoid(np.abs(between), dx=inner[1] - inner[0]))


@dataclass(frozen=True, slots=True)
class Area:
    """Area between a model's strain-volume curve and the measured one; a row of areas.csv.

    Attributes
    ----------
    ml, share : float
        As measured, with the bias and noise of the measurement; and normalised by the tissue's volume and the width of
        the range.
    estimate_ml : float
        Median of the areas to the drawn true fields, which removes the bias of the measurement. This and the following
        attributes are NaN if the measurement uncertainty is unknown.
    low_ml, high_ml : float
        95 % interval from the measurement uncertainty, and from the input uncertainty of the model if it is known.
    floor_ml : float
        Area that a perfect model would get from these uncertainties alone; see `Band`.
    """

    model: str
    load: str
    tissue: str
    ml: float
    share: float
    estimate_ml: float = float("nan")
    low_ml: float = float("nan")
    high_ml: float = float("nan")
    floor_ml: float = float("nan")

    @property
    def levelled(self) -> bool:
        """Whether the model is levelled; no bias is removed from areas of levelled models."""
        return self.model.endswith(LEVELLED)

    @property
    def best_ml(self) -> float:
        """The estimate if there is one, otherwise the area as measured."""
        return self.ml if np.isnan(self.estimate_ml) else self.estimate_ml


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Band of the true strain-volume curve, and the areas to the drawn true fields.

    Attributes
    ----------
    strains, low_ml, high_ml : (k,)
        95 % band of the true V.
    areas_ml : mapping of model to (draws,)
        Area to each drawn true field.
    floors_ml : mapping of model to float
        Area that a perfect model would get: the median area between a drawn true field, narrowed as in `bands`, and the
        next one; the inputs of the model are drawn for both if their uncertainty is known.
    widening : float
        Factor on intervals of draws; see `dvc.trust.error_model.ErrorTable`.
    varied_ml : mapping of model to (draws,)
        As ``areas_ml``, with the inputs of the model drawn, too; only of models whose input uncertainty is known.
    drawn_ml : (draws, k)
        Curves of the drawn true fields at ``strains``; empty if there are several loads.
    """

    strains: FloatArray
    low_ml: FloatArray
    high_ml: FloatArray
    areas_ml: Mapping[str, FloatArray]
    floors_ml: Mapping[str, float]
    widening: float
    varied_ml: Mapping[str, FloatArray] = field(default_factory=dict)
    drawn_ml: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    def interval(self, model: str) -> tuple[float, float, float, float]:
        """Estimate of a model's area, its 95 % interval, and the floor, mL.

        The estimate is the median over the drawn true fields, with the model as it was computed. Noise and wrong inputs
        alone give an area above zero, so an interval that reaches the floor begins at 0.
        """
        low, middle, high = self._widened(self.areas_ml[model], self._added(model))
        floor = self.floors_ml[model]
        return middle, 0.0 if low <= floor else max(low, 0.0), high, floor

    def surely_below(self, model: str, other: str) -> bool:
        """Whether a model's area is significantly smaller than another's (97.5 % of the draws, widened)."""
        difference = self.areas_ml[model] - self.areas_ml[other]
        return self._widened(difference, self._added(model) - self._added(other))[2] < 0.0

    def _added(self, model: str) -> FloatArray:
        """What the draws of a model's inputs add to its area in each draw (draws,)."""
        return self.varied_ml.get(model, self.areas_ml[model]) - self.areas_ml[model]

    def _widened(self, drawn: FloatArray, added: FloatArray) -> tuple[float, float, float]:
        """Lower end, median and upper end of draws: 2.5th and 97.5th percentile, from both uncertainties.

        Only the part of the measurement is widened; the widening was determined for it.
        """
        (low, middle, high), (less, more) = np.quantile(drawn, [_UNSURE, 0.5, _SURE]), self._spread(added)
        below, above = self.widening * (middle - low), self.widening * (high - middle)
        return float(middle - np.hypot(below, less)), float(middle), float(middle + np.hypot(above, more))

    @staticmethod
    def _spread(added: FloatArray) -> tuple[float, float]:
        less, more = np.quantile(added, [_UNSURE, _SURE])
        return max(-float(less), 0.0), max(float(more), 0.0)


def bands(
    truths: Iterable[FloatArray], models: Mapping[str, FloatArray], volumes_ml: FloatArray,
    tissues: Mapping[str, np.ndarray], widening: Callable[[str], float], narrowed: Callable[[FloatArray], FloatArray],
    strains: tuple[float, float] = RANGE, sensitivities: Mapping[str, Sensitivity] | None = None,
) -> dict[str, Band]:  # fmt: skip
    """Bands of the true curve by tissue, from true fields drawn for all cells at once.

    Parameters
    ----------
    truths : iterable of (n,)
        Maximum shear strain of each drawn true field, in the cells; see `dvc.trust.truth_draws.TruthDraws`.
    models, tissues : mapping of name to (n,)
        Maximum shear strain of each model in the cells, and the cells of each tissue.
    widening : callable
        ``widening(tissue)``, as `dvc.trust.error_model.ErrorTable.factor_of`.
    narrowed : callable
        Narrows a drawn true field (n,) to the spread of a perfect model: `dvc.trust.truth_draws.TruthDraws.narrowed`.
    strains : (low, high)
        Range of the areas; the band begins at 0 and ends at one and a half times its upper end.
    sensitivities : mapping of name to Sensitivity, optional
        Input uncertainty of the models of which it is known, in the cells, with as many draws as there are truths.

    Notes
    -----
    A drawn true field is the measured field, which contains noise, minus drawn noise. If the strain varies by little
    more than the noise, the drawn fields have wider distributions than the true field, all similar to each other. The
    area between two of them would then be too small for a perfect model, whose curve is steeper. The inputs of a model
    are wrong once as it was computed and once as they are drawn, so for a perfect model they are drawn with twice the
    variance.
    """
    low, high = strains
    inner, outer = np.linspace(low, high, _GRID), np.linspace(0.0, 1.5 * high, _GRID)
    uncertain = sensitivities or {}

    def curves_of(shear: FloatArray, strains: FloatArray) -> dict[str, FloatArray]:
        return {name: _above(shear[inside], volumes_ml[inside], strains) for name, inside in tissues.items()}

    def areas(first: FloatArray, second: FloatArray) -> FloatArray:
        return np.asarray(np.trapezoid(np.abs(first - second), dx=inner[1] - inner[0]))

    curves = {model: curves_of(shear, inner) for model, shear in models.items()}
    drawn, drawn_outer, perfect = (list[dict[str, FloatArray]]() for _ in range(3))
    varied: dict[str, list[dict[str, FloatArray]]] = {model: [] for model in uncertain}
    wrong: dict[str, list[dict[str, FloatArray]]] = {model: [] for model in uncertain}  # perfect, with wrong inputs
    for number, truth in enumerate(truths):
        drawn.append(curves_of(truth, inner))
        drawn_outer.append(curves_of(truth, outer))
        best = narrowed(truth) if number % _EVERY == 0 else None
        if best is not None:
            perfect.append(curves_of(best, inner))
        for model, sensitivity in uncertain.items():
            change = sensitivity.drawn(number)
            varied[model].append(curves_of(models[model] + change, inner))
            if best is not None:
                wrong[model].append(curves_of(best + np.sqrt(2.0) * change, inner))
    result = {}
    for name, inside in tissues.items():
        on_inner, on_outer = (np.array([one[name] for one in of]) for of in (drawn, drawn_outer))
        factor = widening(name)
        least, _, most = widened(on_outer, factor)
        following = on_inner[1::_EVERY]  # the draws after those that serve as perfect models
        of_perfect = {model: np.array([one[name] for one in wrong.get(model, perfect)]) for model in models}
        floors = {model: float(np.median(areas(of[: len(following)], following))) for model, of in of_perfect.items()}
        of_models = {model: areas(simulated[name], on_inner) for model, simulated in curves.items()}
        of_varied = {model: areas(np.array([one[name] for one in of]), on_inner) for model, of in varied.items()}
        # The true curve falls, so what bounds it at one strain bounds it at smaller (below) or larger ones (above).
        least = np.maximum.accumulate(least[::-1])[::-1]
        most = np.minimum.accumulate(np.minimum(most, volumes_ml[inside].sum()))
        result[name] = Band(outer, least, most, of_models, floors, factor, of_varied, on_outer)
    return result


def _above(values: FloatArray, volumes_ml: FloatArray, strains: FloatArray) -> FloatArray:
    """As `volume_above`, at evenly spaced strains (k,); many times as fast, and exact to rounding."""
    place = np.ceil((values - strains[0]) / (strains[1] - strains[0]))
    bins = np.bincount(np.clip(place, 0, len(strains)).astype(np.int64), volumes_ml, len(strains) + 1)
    return np.asarray(np.cumsum(bins[::-1])[::-1][1:])
