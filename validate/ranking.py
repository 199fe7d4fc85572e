"""Models ranked by the area between strain-volume curves: under each load, over all loads, and over subjects."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
from scipy.special import stdtrit

from dvc.arrays import FloatArray
from dvc.errors import InputError
from fe.result import volume_percentiles
from validate.curves import Area, Band, range_told
from validate.extrapolation import LEVELLED
from validate.load_comparison import NOTHING, LoadComparison
from validate.mapping import ALL
from validate.misfit import Misfit

Pairs = tuple[tuple[str, str], ...]
"""Of models, each in the order of their areas."""

ALL_LOADS = "all loads"
_SURE, _LEVEL, _HIGH = 0.95, 0.975, 0.95

OVER_LOADS = "over all loads"
"""In the statement over all loads, if there is one."""
CLOSER = 0.95
"""A model is better than `NOTHING` if its area is smaller than this fraction of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Ranking:
    """Models over all loads.

    Attributes
    ----------
    areas, nothing : tuple of Area, Area
        Over all loads: of the models that have every load, best first and levelled ones last; and of `NOTHING`.
    statements : tuple of str
        The best match and the significant differences, over all loads, then under each load. Of a load whose area is
        not informative: how many times the measured strain each model predicts, and that it is not.
    not_distinguishable : mapping of load to Pairs
        Pairs whose areas do not differ significantly; those over all loads under `ALL_LOADS`.
    uninformative : tuple of str
        Loads under which hardly any tissue is strained within the range of the areas, and `ALL_LOADS` if all are such.
    """

    areas: tuple[Area, ...]
    nothing: Area
    statements: tuple[str, ...]
    not_distinguishable: Mapping[str, Pairs]
    uninformative: tuple[str, ...] = ()

    def rank(self, model: str) -> tuple[int, int] | None:
        """First and last rank over all loads that a model may have; None if it is not ranked, or no model is."""
        names = [a.model for a in self.areas if not a.levelled]
        if model not in names or ALL_LOADS in self.uninformative:
            return None
        rank, pairs = 1 + names.index(model), self.not_distinguishable[ALL_LOADS]
        return rank - sum(b == model for _, b in pairs), rank + sum(a == model for a, _ in pairs)


def rank_over_loads(loads: Sequence[LoadComparison], odd: Sequence[Misfit] = ()) -> Ranking:
    """Sum the areas over loads, and rank the models.

    Errors of the measurements of different loads are assumed to be independent; wrong inputs of a model are shared by
    all loads. The normalised area is the mean over loads. Statements name loads whose verdict is Do not trust, and so
    models that have a misfit among ``odd`` of that verdict.
    """
    everywhere = [name for name in loads[0].fields.models if all(name in one.fields.models for one in loads)]
    band = summed([one.bands.get(ALL) for one in loads], [*everywhere, NOTHING])
    rows = []
    for name in (*everywhere, NOTHING):
        parts = [a for one in loads for a in one.areas if a.tissue == ALL and a.model == name]
        estimated = band.interval(name) if band is not None and not name.endswith(LEVELLED) else ()
        normalised = float(np.mean([a.share for a in parts]))
        rows.append(Area(name, ALL_LOADS, ALL, sum(a.ml for a in parts), normalised, *estimated))
    nothing = rows.pop()
    rows.sort(key=lambda a: (a.levelled, a.best_ml))
    ranked = [a for a in rows if not a.levelled]
    uninformative = [one.load for one in loads if one.hardly_strained]
    uninformative += [ALL_LOADS] * (len(uninformative) == len(loads))
    informative = None if ALL_LOADS in uninformative else band
    pairs = {ALL_LOADS: _pairs(ranked, informative)}
    pairs |= {one.load: _pairs(one.ranked(), None if one.hardly_strained else one.bands.get(ALL)) for one in loads}
    many = len(loads) > 1 and bool(ranked) and informative is not None
    weak = [one for one in loads if one.hardly_strained]
    statements = [_under(one, pairs[one.load], odd, many) for one in loads if one not in weak]
    # First what a model predicts under the load with most strain: a report shows few paragraphs above its pictures.
    statements += [_by_percentile(one) for one in sorted(weak, key=lambda one: -_high(one, "measured"))]
    statements += [_under(one, pairs[one.load], odd, many) for one in weak]
    if many:
        distrusted = [one.load for one in loads if one.case.verdict and one.case.verdict.level == "distrust"]
        caveat = f" It includes {', '.join(distrusted)}, whose registration has the verdict Do not trust."
        caveat = caveat * bool(distrusted) + _not_trusted(odd)
        strains = loads[0].criteria.strains
        statements.insert(0, _statement(OVER_LOADS, ranked, nothing, pairs[ALL_LOADS], caveat, strains))
    return Ranking(tuple(rows), nothing, tuple(s for s in statements if s), pairs, tuple(uninformative))


def no_nearer(areas: Iterable[Area], nothing: Area) -> list[str]:
    """Ranked models whose area is not clearly (5 %) smaller than that of `NOTHING` under the same load."""
    return [a.model for a in areas if a.best_ml >= CLOSER * nothing.best_ml and not a.levelled]


def summed(bands: Sequence[Band | None], models: Sequence[str]) -> Band | None:
    """Areas to the drawn true fields, over all loads; None if the uncertainty of one is unknown.

    True fields are drawn for each load on its own; the inputs of models are the same under all loads in a draw.
    """
    known = [band for band in bands if band is not None]
    if len(known) < len(bands):
        return None
    areas = {name: np.sum([band.areas_ml[name] for band in known], axis=0) for name in models}
    varied = {
        name: np.sum([band.varied_ml.get(name, band.areas_ml[name]) for band in known], axis=0)
        for name in models
        if any(name in band.varied_ml for band in known)
    }
    floors, first = {name: sum(band.floors_ml[name] for band in known) for name in models}, known[0]
    widest = max(band.widening for band in known)
    return Band(first.strains, first.low_ml, first.high_ml, areas, floors, widest, varied)


def _pairs(ranked: Sequence[Area], band: Band | None) -> Pairs:
    """Pairs whose areas do not differ significantly; all if the uncertainty is unknown."""
    pairs = combinations([a.model for a in ranked], 2)
    return tuple((a, b) for a, b in pairs if band is None or not (band.surely_below(a, b) or band.surely_below(b, a)))


def _not_trusted(odd: Iterable[Misfit]) -> str:
    """A sentence with the models that are not to be trusted; empty without any."""
    names = dict.fromkeys(one.model for one in odd if one.level == "distrust")
    return f" Do not trust the rank of {', '.join(names)}: see the warning on its file." if names else ""


def _under(one: LoadComparison, pairs: Pairs, odd: Sequence[Misfit], brief: bool) -> str:
    """The statement on one load; empty if the uncertainty is unknown."""
    if one.hardly_strained:
        low = one.criteria.strains[0]
        few = f"the measured maximum shear strain exceeds {low:g} in less than 1 % of the tissue"
        return f"{one.load}: {few}, so the area metric is not informative."
    distrusted = bool(one.case.verdict and one.case.verdict.level == "distrust")
    caveat = " The registration of this load has the verdict Do not trust." * distrusted
    caveat += _not_trusted(each for each in odd if each.load == one.load)
    known = ALL in one.bands
    strains = None if brief else one.criteria.strains
    return _statement(f"under {one.load}", one.ranked(), one.nothing, pairs, caveat, strains) if known else ""


def _by_percentile(one: LoadComparison) -> str:
    """How many times the measured strain each model predicts, where the area is not informative; empty without any.

    By its 95th percentile a model without deformation is wrong by the measured strain, so one that predicts twice the
    measured strain or more is no better.
    """
    models = [area.model for area in one.ranked()]
    high, measured = {name: _high(one, name) for name in models}, _high(one, "measured")
    if not models or not measured > 0.0:
        return ""
    first, *others = (f"{_times(high[name] / measured)} times" for name in models)
    shown = f"95th percentile in all soft tissue: {high[models[0]]:.3f} against {measured:.3f} as measured"
    told = [f"{one.load} (area metric not informative): {models[0]} predicts {first} the measured strain ({shown})"]
    told += [f"{name} {times} ({high[name]:.3f})" for name, times in zip(models[1:], others, strict=True)]
    worse = [name for name in models if high[name] >= 2.0 * measured]
    no_better = "no better than a model without deformation"
    tail = "" if not worse else f", {no_better}" if len(models) == 1 else f"; {no_better}: {', '.join(worse)}"
    return f"{', '.join(told)}{tail}."


def _high(one: LoadComparison, name: str) -> float:
    """The 95th percentile (by volume) of the maximum shear strain of a field in the compared cells."""
    where = one.fields.common
    shear, volumes = one.fields.by_name[name].max_shear[where], one.fields.volumes_ml[where]
    return volume_percentiles(shear, volumes, [_HIGH])[0]


def _times(ratio: float) -> str:
    return f"{ratio:.1f}" if ratio < 10.0 else f"{ratio:.0f}"


def _statement(
    where: str, ranked: Sequence[Area], nothing: Area, pairs: Pairs, caveat: str, strains: tuple[float, float] | None
) -> str:
    """The best model, the models not distinguishable from it, and its area; of a single model, its area.

    Without ``strains``, the range of the area, it follows a statement that says what the area is.
    """
    if not ranked:
        return ""
    best = ranked[0]
    area = f"{best.best_ml:.2f} mL (95 % interval {best.low_ml:.2f} to {best.high_ml:.2f})"
    scale = f"0 mL is perfect agreement, {nothing.best_ml:.2f} mL a model without deformation."
    over = "" if strains is None else f", {range_told(strains)}"
    if len(ranked) == 1:
        between = f"Area between the strain-volume curves of {best.model} and the measurement {where}{over}"
        return f"{between}: {area}; {scale}{caveat}"
    near = [b for a, b in pairs if a == best.model]
    of_all = f"; not distinguishable from {', '.join(near)}." if near else ", significantly better than every other."
    between = f"Area between its strain-volume curve and the measured one{over}" if over else "Area"
    between += ", summed over the loads" * (where == OVER_LOADS)
    worse = " It is no better than a model without deformation (by 5 %)." * (best.model in no_nearer(ranked, nothing))
    return f"Best match {where} (area metric): {best.model}{of_all} {between}: {area}; {scale}{worse}{caveat}"


@dataclass(frozen=True, slots=True)
class CohortRank:
    """A model over subjects; a row of ranking.csv.

    Attributes
    ----------
    subjects : int
        Number of subjects with a result of every model.
    mean, low, high, least, greatest : float
        Mean normalised area between curves, its 95 % interval over subjects (Student's t; NaN for one subject), and
        its range.
    best_in : int
        Subjects in which it has the smallest area.
    behind, behind_low, behind_high : float
        Mean paired difference to the area of the best model, and its interval, which is simultaneous for all pairs of
        models and therefore valid although the same subjects determined the best model.
    """

    model: str
    subjects: int
    mean: float
    low: float
    high: float
    least: float
    greatest: float
    best_in: int
    behind: float
    behind_low: float
    behind_high: float

    @property
    def differs_from_best(self) -> bool:
        """Whether it is significantly worse than the best model."""
        return bool(self.behind_low > 0.0)


def rank_over_subjects(shares: Mapping[str, Mapping[str, float]]) -> tuple[CohortRank, ...]:
    """Rank models by their normalised areas over all subjects that have a result of every model; best first.

    Subjects are assumed to be an independent sample of one population. Intervals are those of the mean: they narrow
    with more subjects, and include the measurement error as far as it varies between subjects.

    Differences have Tukey's simultaneous 95 % intervals (honestly significant difference, subjects as blocks: Kutner
    and others, Applied Linear Statistical Models, section 21.5), which assume one residual variance for all models.

    Raises
    ------
    InputError
        If no subject has a result of every model.
    """
    names = list(shares)
    subjects = [s for s in dict.fromkeys(s for of in shares.values() for s in of) if all(s in shares[n] for n in names)]
    if not names or not subjects:
        raise InputError("Models cannot be ranked over subjects, because no subject has a result of every model.")
    table = np.array([[shares[n][s] for s in subjects] for n in names])
    order = np.argsort(table.mean(axis=1), kind="stable")
    first, nearest, half = table[order[0]], np.argmin(table, axis=0), _simultaneous(table)
    ranks = []
    for at in order:
        row, behind = table[at], float((table[at] - first).mean())
        mean, each = float(row.mean()), float("nan")
        if (count := len(row)) > 1:
            each = float(stdtrit(count - 1, _LEVEL) * row.std(ddof=1) / np.sqrt(count))
        extremes, best_in = (float(row.min()), float(row.max())), int(np.count_nonzero(nearest == at))
        differences = behind, behind - half, behind + half
        ranks.append(
            CohortRank(names[at], len(subjects), mean, mean - each, mean + each, *extremes, best_in, *differences)
        )
    return tuple(ranks)


def _simultaneous(table: FloatArray) -> float:
    """Half width of the simultaneous 95 % intervals of all differences between means of models (k, subjects)."""
    models, subjects = table.shape
    if models < 2 or subjects < 2:
        return float("nan")
    rest = table - table.mean(axis=0) - table.mean(axis=1)[:, None] + table.mean()
    freedom = (models - 1) * (subjects - 1)
    spread = np.sqrt((rest**2).sum() / freedom / subjects)
    return float(_of_studentized_range(models, freedom) * spread)


@cache
def _of_studentized_range(models: int, freedom: int) -> float:
    """Its 95 % quantile, an integral that takes a tenth of a second."""
    from scipy.stats import studentized_range  # takes 0.3 s, only needed for cohorts

    return float(studentized_range.ppf(_SURE, models, freedom))
