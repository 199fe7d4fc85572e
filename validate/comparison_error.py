"""Comparison error E = S - D of each statistic, and its standard uncertainties after ASME V&V 20-2009.

S is a statistic of the simulation and D that of the measurement, with its bias removed. The validation uncertainty is
u_val = sqrt(u_num^2 + u_input^2 + u_D^2), from the discretisation, the inputs of the model, and the measurement.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial

import numpy as np

from dvc.arrays import FloatArray
from dvc.report.page import Section, Table
from validate.curves import Band, area_to
from validate.extrapolation import LEVELLED
from validate.mapping import MappedFields
from validate.sensitivity import MESH, Sensitivity

COVERAGE = 2.0
"""Coverage factor k of the expanded uncertainty: about 95 % for a normal distribution."""

AREA = "area"
_PERCENTILES = {"median": 50.0, "p95": 95.0}
_NORMAL = 1.96  # half width of a 95 % interval in standard deviations of a normal distribution
_SURE = (0.025, 0.5, 0.975)


@dataclass(frozen=True, slots=True)
class ComparisonError:
    """A statistic of one model, tissue and load, simulated and measured; a row of comparison_error.csv.

    Attributes
    ----------
    statistic : str
        "median" or "p95" of the maximum shear strain, "volume above 0.3" (mL), or "area" between the curves (mL).
    simulated, measured : float
        Figure of the model (S), and median over the drawn true fields (D), which removes the bias of the measurement.
        NaN for the area, which is a difference itself.
    error : float
        E = S - D; for the area, its estimate.
    u_num, u_input, u_d : float
        Standard uncertainties from the mesh, from the other inputs of the model, and from the measurement. NaN if
        unknown.
    u_val : float
        Root of the sum of the squares of those that are known; NaN if u_d is unknown.
    low, high : float
        E - k u_val and E + k u_val with k = 2; for the area, its 95 % interval.
    """

    model: str
    load: str
    tissue: str
    statistic: str
    simulated: float
    measured: float
    error: float
    u_num: float
    u_input: float
    u_d: float
    u_val: float
    low: float
    high: float

    @property
    def significant(self) -> bool:
        """Whether the interval of the error excludes zero; not where the error is unknown."""
        return self.low > 0.0 or self.high < 0.0


def comparison_errors(
    load: str, fields: MappedFields, known: Mapping[str, Band], sensitivities: Mapping[str, Sensitivity],
    thresholds: Sequence[float], strains: tuple[float, float],
) -> Iterator[ComparisonError]:  # fmt: skip
    """Comparison error of each model, tissue and statistic under one load, if the measurement's uncertainty is known.

    ``known`` has the bands by tissue, ``sensitivities`` are those of models in the common cells. Statistics of the
    measurement beyond the range of the bands are NaN.
    """
    common, levels = fields.common, [t for t in thresholds if t <= 1.5 * strains[1]]
    names = [*_PERCENTILES, *(f"volume above {level:g}" for level in levels)]
    for tissue, where in fields.parts.items():
        if tissue not in known:
            continue
        band, inside = known[tissue], where[common]
        volumes = fields.volumes_ml[where]
        statistics = partial(_statistics, volumes_ml=volumes, levels=levels)
        low, measured, high = np.quantile(_drawn_statistics(band, levels, float(volumes.sum())), _SURE, axis=0)
        u_d = band.widening * (high - low) / (2.0 * _NORMAL)
        middle = np.median(band.drawn_ml, axis=0)
        for model, field in fields.models.items():
            if model.endswith(LEVELLED):  # has the bias of the measurement, which D has not
                continue
            shear, of = field.max_shear[where], sensitivities.get(model)
            changes = {} if of is None else {name: change[inside] for name, change in of.changes.items()}
            simulated = statistics(shear)
            steps = {name: 0.5 * (statistics(shear + c) - statistics(shear - c)) for name, c in changes.items()}
            rows = zip(names, simulated, measured, u_d, *steps.values(), strict=True)
            for name, *numbers in rows:
                s, d, u, *by = map(float, numbers)
                parts = _parts(dict(zip(steps, by, strict=True)), u)
                reach = COVERAGE * parts[-1]
                yield ComparisonError(model, load, tissue, name, s, d, s - d, *parts, s - d - reach, s - d + reach)
            area = partial(area_to, volumes_ml=volumes, strains=strains, at=band.strains, curve_ml=middle)
            here, (estimate, least, most, _) = area(shear), band.interval(model)
            by_input = {
                name: float(np.sqrt(0.5 * ((area(shear + c) - here) ** 2 + (area(shear - c) - here) ** 2)))
                for name, c in changes.items()
            }
            ends = np.quantile(band.areas_ml[model], _SURE)
            parts = _parts(by_input, float(band.widening * (ends[2] - ends[0]) / (2.0 * _NORMAL)))
            yield ComparisonError(model, load, tissue, AREA, np.nan, np.nan, estimate, *parts, least, most)


def validation_section(load: str, errors: Sequence[ComparisonError], tissue: str) -> list[Section]:
    """A folded section of the report with the errors of one load in one tissue; none without any."""
    shown = [one for one in errors if one.tissue == tissue]
    if not shown:
        return []
    statistics = [one for one in shown if one.statistic != AREA]
    strains = [one for one in statistics if not np.isnan(one.error)]
    beyond = sum(one.significant for one in strains)
    lacking = {
        "u_num": [one.model for one in strains if np.isnan(one.u_num)],
        "u_input": [one.model for one in strains if np.isnan(one.u_input)],
    }
    cause = "The model form is the likely cause: the uncertainties of mesh, inputs and measurement do not explain it."
    if any(lacking.values()):
        cause = "The measurement uncertainty does not explain this; the uncertainties not given (next lines) may."
    words = [
        "In all soft tissue, the comparison error exceeds the expanded validation uncertainty (2 u_val) in "
        f"{beyond} of {len(strains)} quantities of all models (areas not counted). {cause}"
    ]
    known_as = {"u_num": "Uncertainty of the mesh (u_num)", "u_input": "Uncertainty of the inputs (u_input)"}
    words += [f"{known_as[u]} not given: {', '.join(dict.fromkeys(of))}." for u, of in lacking.items() if of]
    if any(lacking.values()):
        words.append(
            "For material sets that a study simulates, [uncertainty] in the study file computes them; for other "
            "models, give variants."
        )
    if unknown := dict.fromkeys(one.statistic for one in statistics if np.isnan(one.error)):
        words.append(f"D and E are not defined beyond the range of the measured curves: {', '.join(unknown)}.")
    columns = ("model", "quantity", "S", "D", "E = S - D", "u_num", "u_input", "u_D", "u_val", "E, lower", "upper")
    table = Table(
        "Comparison error and validation uncertainty (ASME V&V 20)", columns,
        tuple((one.model, one.statistic, *astuple(one)[4:]) for one in shown),
        "S: simulated; D: measured, with the bias of the measurement removed. Standard uncertainties from the mesh "
        "(u_num), the other inputs of the model (u_input) and the measurement (u_D); u_val is the root sum of squares "
        "of the known ones. Interval: E ± 2 u_val, for the area its 95 % interval. A dash: not given; the area, itself "
        "a difference, has no S and D. p95: 95th percentile. Strains have no unit, volumes and areas are in mL. Single "
        "tissues are in comparison_error.csv.",
    )  # fmt: skip
    return [Section(f"{load}, validation uncertainty", None, (table,), paragraphs=tuple(words), folded=True)]


def _parts(by_input: Mapping[str, float], u_d: float) -> tuple[float, float, float, float]:
    """u_num, u_input, u_D and u_val from the change of a statistic by one standard uncertainty of each input."""
    inputs = [change for name, change in by_input.items() if name != MESH]
    u_num = abs(float(by_input[MESH])) if MESH in by_input else float("nan")
    u_input = float(np.sqrt(np.sum(np.square(inputs)))) if inputs else float("nan")
    squares = [u**2 for u in (u_num, u_input) if not np.isnan(u)]
    return u_num, u_input, float(u_d), float(np.sqrt(sum(squares) + u_d**2))


def _statistics(shear: FloatArray, volumes_ml: FloatArray, levels: Sequence[float]) -> FloatArray:
    """Median and 95th percentile by volume, and volumes above the levels (mL), of a maximum shear strain (n,)."""
    order = np.argsort(shear)
    share = np.cumsum(volumes_ml[order]) / volumes_ml.sum()
    at = np.searchsorted(share, [percent / 100.0 for percent in _PERCENTILES.values()])
    above = [float(volumes_ml[shear > level].sum()) for level in levels]
    return np.array([*shear[order][np.minimum(at, len(shear) - 1)], *above])


def _drawn_statistics(band: Band, levels: Sequence[float], volume_ml: float) -> FloatArray:
    """The statistics of `_statistics` of each drawn true field, (draws, statistics), from its curve."""
    rows = []
    for curve in band.drawn_ml:
        falling = curve[::-1]  # rising volumes, for the inverse of the curve
        of = [(1.0 - percent / 100.0) * volume_ml for percent in _PERCENTILES.values()]
        inverse = [np.nan if v < falling[0] else float(np.interp(v, falling, band.strains[::-1])) for v in of]
        rows.append([*inverse, *np.interp(levels, band.strains, curve)])
    return np.array(rows)
