"""Strain intensity: strain-volume curves, and the area between two of them.

V(s) is the volume of the cells whose maximum shear strain exceeds s: an exact step function, without bins. The metric
is A = integral of |V_FE - V_DVC| ds over a range of strain, in mL: the area validation metric (Ferson, Oberkampf and
Ginzburg 2008) with volume in place of probability. The normalised area, A over the tissue's volume and the width of
the range, is dimensionless.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.trust.error_model import widened
from dvc.trust.regions import volume_above
from validate.extrapolation import LEVELLED

RANGE = (0.2, 0.5)
"""Range of maximum shear strain over which curves are compared by default."""

MOST_STRAIN = 3.0
"""Largest upper end of a range; larger values are probably in percent."""

DRAWS = 200
"""Number of true fields drawn from the error model for the curves and areas of a load."""

_GRID = 301
_SURE = 0.975
_EVERY = 4  # every so many draws, one serves as a perfect model


def check_range(strains: tuple[float, float]) -> None:
    """InputError unless a range of maximum shear strain increases and lies within 0 to 3."""
    if not 0.0 <= strains[0] < strains[1] <= MOST_STRAIN:
        raise InputError(
            f"The range of strain must increase and lie within 0 to {MOST_STRAIN:g} (not in percent); got "
            f"{strains[0]:g} to {strains[1]:g}."
        )


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
        95 % interval from the measurement uncertainty.
    floor_ml : float
        Area that a perfect model would get from noise alone; see `Band`.
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
    floor_ml : float
        Area that a perfect model would get: the median area between a drawn true field, narrowed as in `bands`, and the
        next one.
    widening : float
        Factor on intervals of draws; see `dvc.trust.error_model.ErrorTable`.
    """

    strains: FloatArray
    low_ml: FloatArray
    high_ml: FloatArray
    areas_ml: Mapping[str, FloatArray]
    floor_ml: float
    widening: float

    def interval(self, model: str) -> tuple[float, float, float, float]:
        """Estimate of a model's area, its 95 % interval, and the floor, mL.

        Noise alone gives an area above zero, so an interval that reaches the floor begins at 0.
        """
        low, middle, high = (float(v[0]) for v in widened(self.areas_ml[model][:, None], self.widening))
        return middle, 0.0 if low <= self.floor_ml else low, high, self.floor_ml

    def surely_below(self, model: str, other: str) -> bool:
        """Whether a model's area is significantly smaller than another's (97.5 % of the draws, widened)."""
        difference = self.areas_ml[model] - self.areas_ml[other]
        middle, high = np.median(difference), np.quantile(difference, _SURE)
        return bool(middle + self.widening * (high - middle) < 0.0)


def bands(
    truths: Iterable[FloatArray], models: Mapping[str, FloatArray], volumes_ml: FloatArray,
    tissues: Mapping[str, np.ndarray], widening: float, narrowed: Callable[[FloatArray], FloatArray],
    strains: tuple[float, float] = RANGE,
) -> dict[str, Band]:  # fmt: skip
    """Bands of the true curve by tissue, from true fields drawn for all cells at once.

    Parameters
    ----------
    truths : iterable of (n,)
        Maximum shear strain of each drawn true field, in the cells; see `dvc.trust.error_model.TruthDraws`.
    models, tissues : mapping of name to (n,)
        Maximum shear strain of each model in the cells, and the cells of each tissue.
    narrowed : callable
        Narrows a drawn true field (n,) to the spread of a perfect model: `dvc.trust.error_model.TruthDraws.narrowed`.
    strains : (low, high)
        Range of the areas; the band begins at 0 and ends at one and a half times its upper end.

    Notes
    -----
    A drawn true field is the measured field, which contains noise, minus drawn noise. If the strain varies by little
    more than the noise, the drawn fields have wider distributions than the true field, all similar to each other. The
    area between two of them would then be too small for a perfect model, whose curve is steeper.
    """
    low, high = strains
    inner, outer = np.linspace(low, high, _GRID), np.linspace(0.0, 1.5 * high, _GRID)

    def curves_of(shear: FloatArray, strains: FloatArray) -> dict[str, FloatArray]:
        return {name: volume_above(shear[inside], volumes_ml[inside], strains) for name, inside in tissues.items()}

    def areas(first: FloatArray, second: FloatArray) -> FloatArray:
        return np.asarray(np.trapezoid(np.abs(first - second), dx=inner[1] - inner[0]))

    curves = {model: curves_of(shear, inner) for model, shear in models.items()}
    drawn, perfect = list[dict[str, FloatArray]](), list[dict[str, FloatArray]]()
    for number, truth in enumerate(truths):
        drawn.append(curves_of(truth, np.concatenate([outer, inner])))
        if number % _EVERY == 0:
            perfect.append(curves_of(narrowed(truth), inner))
    result = {}
    for name, inside in tissues.items():
        on_outer, on_inner = np.split(np.array([of[name] for of in drawn]), [_GRID], axis=1)
        least, _, most = widened(on_outer, widening)
        following = on_inner[1::_EVERY]  # the draws after those that serve as perfect models
        floor = np.median(areas(np.array([of[name] for of in perfect])[: len(following)], following))
        of_models = {model: areas(simulated[name], on_inner) for model, simulated in curves.items()}
        most = np.minimum(most, volumes_ml[inside].sum())
        result[name] = Band(outer, least, most, of_models, float(floor), widening)
    return result
