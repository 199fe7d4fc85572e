"""Modified area validation metric: by how much measured strain is larger, and by how much smaller, than simulated.

The distributions are those of strain over the volume of a tissue. The cells are the whole tissue, not samples of it.
"""

from dataclasses import dataclass

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.trust.regions import volume_above

_FEWEST, _MANY = 4.0, 1.25  # F_0 and F_1 of the safety factor


def safety_factor(samples: int | None) -> float:
    """Factor F_s on the interval of a model, for a measured distribution known from ``samples`` experiments.

    F_s = 1.25 + 1.2 (4 - 1.25) / N^(1/3), and 1 where the distribution is complete (None). Independent experiments
    count, such as subjects: the cells of one measured field are not samples. InputError below two.
    """
    if samples is None:
        return 1.0
    if samples < 2:
        raise InputError(f"The modified area metric needs at least two experiments, or a whole field; got {samples}.")
    return float(_MANY + 1.2 * (_FEWEST - _MANY) / np.cbrt(samples))


@dataclass(frozen=True, slots=True)
class ModelForm:
    """Modified area validation metric of a model in one tissue; a row of mavm.csv.

    Attributes
    ----------
    mean, measured_mean : float
        Volume-weighted mean of the maximum shear strain.
    d_plus, d_minus : float
        Area between the cumulative distributions where measured strain is the larger, and where it is the smaller, in
        strain. Their difference is that of the means, and their sum the area validation metric.
    low, high : float
        Interval of the mean with the uncertainty of the model's form: mean - F_s d_minus to mean + F_s d_plus. Every
        percentile of the model has the same margins.
    """

    model: str
    load: str
    tissue: str
    mean: float
    measured_mean: float
    d_plus: float
    d_minus: float
    low: float
    high: float


def signed_areas(measured: FloatArray, simulated: FloatArray, volumes_ml: FloatArray) -> tuple[float, float]:
    """d+ and d- between the distributions of two fields (n,) over the volumes (n,) of the same cells; exact.

    d+ = integral of max(F_simulated - F_measured, 0) over strain, and d- that of max(F_measured - F_simulated, 0), with
    the cumulative distributions F by volume. InputError if a cell has no value.

    Examples
    --------
    >>> one = np.ones(2)
    >>> signed_areas(np.array([0.2, 0.5]), np.array([0.3, 0.3]), one)
    (0.1, 0.05)
    """
    if missing := np.count_nonzero(~np.isfinite(measured + simulated)):
        raise InputError(f"{missing} of {len(measured)} cells have no value in both fields; leave them out of both.")
    edges = np.unique(np.concatenate([measured, simulated]))
    larger = volume_above(measured, volumes_ml, edges[:-1]) - volume_above(simulated, volumes_ml, edges[:-1])
    parts = larger / volumes_ml.sum() * np.diff(edges)
    return round(float(np.maximum(parts, 0.0).sum()), 12), round(float(np.maximum(-parts, 0.0).sum()), 12)


def model_form(
    of: tuple[str, str, str], measured: FloatArray, simulated: FloatArray, volumes_ml: FloatArray,
    samples: int | None = None,
) -> ModelForm:  # fmt: skip
    """The row ``of`` a model, load and tissue, from fields (n,) in the same cells; ``samples`` as `safety_factor`.

    References
    ----------
    Voyles and Roy, 17th AIAA Non-Deterministic Approaches Conference, 2015.
    """
    plus, minus = signed_areas(measured, simulated, volumes_ml)
    weights, factor = volumes_ml / volumes_ml.sum(), safety_factor(samples)
    mean = float(weights @ simulated)
    interval = mean - factor * minus, mean + factor * plus
    return ModelForm(*of, mean, float(weights @ measured), plus, minus, *interval)
