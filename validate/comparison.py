"""One load, measured and simulated by several models: every figure of the comparison."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.protocol import Deformation
from dvc.images.image import LabelMap
from dvc.mesh import TetMesh
from dvc.trust.error_model import ErrorTable
from dvc.trust.truth_draws import TruthDraws
from validate.agreement import Agreement, Travel, agreements, travel
from validate.curves import DRAWS, RANGE, Area, Band, area_between, bands
from validate.extrapolation import LEVELLED
from validate.fe_result import FeResult
from validate.location import LEAST_ML, Overlap, Threshold, neighbours, overlap
from validate.location_intervals import DRAWS as LOCATED
from validate.location_intervals import with_intervals
from validate.mapping import ALL, Mapped, mapped

_STRAINED = 0.01

NOTHING = "no deformation"
"""A model that predicts no strain anywhere: what areas are to be seen beside, and outside the order."""


Pairs = tuple[tuple[str, str], ...]
"""Of models, each in the order of their areas."""

ALL_LOADS = "all loads"


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Models against the measurement, under one load.

    Attributes
    ----------
    load : str
    found : Mapped
    areas : tuple of Area
        By model and tissue; that of all soft tissue first. Those of `NOTHING` come last.
    overlaps : tuple of Overlap
    agreements : tuple of Agreement
    travels : tuple of Travel
    bands : mapping of tissue to Band
        Empty where the measurement's error is not known.
    strains : (low, high)
        Range of the areas.
    """

    load: str
    found: Mapped
    areas: tuple[Area, ...]
    overlaps: tuple[Overlap, ...]
    agreements: tuple[Agreement, ...]
    travels: tuple[Travel, ...]
    bands: Mapping[str, Band]
    strains: tuple[float, float] = RANGE

    @property
    def hardly_strained(self) -> bool:
        """Whether under a hundredth of the tissue is measured above the lower end of the range."""
        where = self.found.common
        volumes = self.found.volumes_ml[where]
        above = volumes[self.found.measured.max_shear[where] > self.strains[0]].sum()
        return bool(above < _STRAINED * volumes.sum())

    def ranked(self, tissue: str = ALL) -> list[Area]:
        """Areas of a tissue, the smallest first: as estimated from the truths drawn, where the error is known.

        Levelled models are left out, as their areas are those as found, and of another kind; so is `NOTHING`.
        """
        models = (a for a in self.areas if a.tissue == tissue and a.model != NOTHING and not a.model.endswith(LEVELLED))
        return sorted(models, key=lambda a: a.best_ml)

    def not_told_apart(self) -> Pairs:
        """Pairs of models of which the measurement cannot tell which is nearer; all where its error is not known."""
        return _not_told_apart(self.ranked(), None if self.hardly_strained else self.bands.get(ALL))


def compare(
    load: str,
    measured: Deformation,
    results: Sequence[FeResult],
    labels: LabelMap,
    *,
    bones: Sequence[str],
    normal: FloatArray,
    mesh: TetMesh | None = None,
    table: ErrorTable | None = None,
    strains: tuple[float, float] = RANGE,
    thresholds: Sequence[Threshold] = (),
    least_ml: float = LEAST_ML,
    seed: int = 1,
) -> Comparison:
    """Compare models with a measurement of one load, at the centroids of one mesh's cells.

    Parameters
    ----------
    load : str
    measured : Deformation
        Of tissue relative to its bone, reference configuration, LPS mm.
    results : sequence of FeResult
    labels : LabelMap
        Of the unloaded image.
    bones : sequence of str
        Labels of bone.
    normal : (3,)
        The plate's outward unit normal, LPS.
    mesh : TetMesh, optional
        Where to compare; the first model's by default.
    table : ErrorTable, optional
        The measurement's error; without it no figure has an interval, and no difference counts as seen.
    strains : (low, high)
        Range of maximal shear over which curves are compared.
    thresholds : sequence of Threshold
        Above which clusters are looked at.
    least_ml : float
        Volume of the smallest cluster that counts.
    seed : int
        Of the truths drawn; those of different loads are independent.

    Raises
    ------
    InputError
        As `mapped`.
    """
    models = {result.name: result.deformation for result in results}
    found = mapped(mesh if mesh is not None else results[0].mesh, labels, bones, measured, models)
    common = found.common
    tissues: dict[str, BoolArray] = {ALL: common}
    tissues |= {
        name: common & (found.tissue == name) for name in found.tissues if (common & (found.tissue == name)).any()
    }
    truths: list[FloatArray] = []
    told = {} if table is None else _bands(found, tissues, table, strains, zlib.crc32(load.encode()) + seed, truths)
    areas = []
    for name, shear in _shears(found).items():
        for tissue, where in tissues.items():
            volumes = found.volumes_ml[where]
            area = area_between(found.measured.max_shear[where], shear[where], volumes, strains)
            share = area / volumes.sum() / (strains[1] - strains[0])
            # what was measured itself carries the measurement's bias as well: as found, like is compared with like
            estimated = told[tissue].interval(name) if tissue in told and not name.endswith(LEVELLED) else ()
            areas.append(Area(name, load, tissue, area, share, *estimated))
    touching = neighbours(found.mesh)
    measured_shear = np.where(common, found.measured.max_shear, -1.0)
    overlaps = [
        overlap(
            name, load, threshold.max_shear, measured_shear, np.where(common, field.max_shear, -1.0),
            found.volumes_ml, found.points_mm, touching, least_ml,
        )
        for name, field in found.models.items()
        for threshold in thresholds
    ]  # fmt: skip
    if table is not None:
        overlaps = with_intervals(
            overlaps, truths, {name: field.max_shear[common] for name, field in found.models.items()},
            found.volumes_ml[common], found.points_mm[common], touching[common][:, common], least_ml, table.factor,
        )  # fmt: skip
    rows = [row for name in models for row in agreements(found, name, load)]
    travels = [travel(found, r.name, load, r.deformation, measured, normal) for r in results]
    return Comparison(load, found, tuple(areas), tuple(overlaps), tuple(rows), tuple(travels), told, strains)


@dataclass(frozen=True, slots=True, eq=False)
class Total:
    """Models over all loads.

    Attributes
    ----------
    areas : tuple of Area
        Of the models that have every load, the nearest first; levelled ones last.
    nothing : Area
        Of `NOTHING`.
    told : tuple of str
        Which models the measurement tells apart, over all loads and under each.
    not_told_apart : mapping of load to Pairs
        As in `Comparison`; those over all loads under `ALL_LOADS`.
    """

    areas: tuple[Area, ...]
    nothing: Area
    told: tuple[str, ...]
    not_told_apart: Mapping[str, Pairs]

    def place(self, model: str) -> tuple[int, int] | None:
        """First and last place over all loads that a model may have; None for one that is not in the order."""
        names = [a.model for a in _in_order(self.areas)]
        if model not in names:
            return None
        place, pairs = 1 + names.index(model), self.not_told_apart[ALL_LOADS]
        return place - sum(b == model for _, b in pairs), place + sum(a == model for a, _ in pairs)


def total(done: Sequence[Comparison], distrusted: Sequence[str] = ()) -> Total:
    """Areas over all loads, and what can be told.

    Loads are measured one by one, so their errors are taken as independent. The share is the mean of the loads' shares.
    What is told says of the ``distrusted`` loads that their registration is not to be trusted.
    """
    everywhere = [name for name in done[0].found.models if all(name in one.found.models for one in done)]
    bands_of = [one.bands[ALL] for one in done if ALL in one.bands]
    whole: Band | None = None
    if len(bands_of) == len(done):
        areas = {name: np.sum([band.areas_ml[name] for band in bands_of], axis=0) for name in (*everywhere, NOTHING)}
        floor = float(sum(band.floor_ml for band in bands_of))
        first = bands_of[0]
        whole = Band(first.strains, first.low_ml, first.high_ml, areas, floor, max(b.widening for b in bands_of))
    rows = []
    for name in (*everywhere, NOTHING):
        parts = [a for one in done for a in one.areas if a.tissue == ALL and a.model == name]
        estimated = whole.interval(name) if whole is not None and not name.endswith(LEVELLED) else ()
        share = float(np.mean([a.share for a in parts]))
        rows.append(Area(name, ALL_LOADS, ALL, sum(a.ml for a in parts), share, *estimated))
    nothing = rows.pop()
    rows.sort(key=lambda a: (a.model.endswith(LEVELLED), a.best_ml))
    told = []
    for one in done:
        if one.hardly_strained:
            told.append(
                f"Under {one.load} hardly any tissue is measured above the range's lower end: areas do not judge."
            )
        elif ALL in one.bands:
            sentence = _told(f"under {one.load}", one.ranked(), one.bands[ALL])
            doubt = " Its registration is not to be trusted." if one.load in distrusted else ""
            told.append(sentence + doubt if sentence else "")
    if len(done) > 1 and everywhere and whole is not None and not all(one.hardly_strained for one in done):
        sentence = _told("over all loads", _in_order(rows), whole)
        counted = [one.load for one in done if one.load in distrusted]
        doubt = (
            f" The registration of {', '.join(counted)}, which counts in it, is not to be trusted." if counted else ""
        )
        told.insert(0, sentence + doubt if sentence else "")
    judged = None if all(one.hardly_strained for one in done) else whole
    pairs = {ALL_LOADS: _not_told_apart(_in_order(rows), judged)} | {one.load: one.not_told_apart() for one in done}
    return Total(tuple(rows), nothing, tuple(sentence for sentence in told if sentence), pairs)


def _in_order(areas: Sequence[Area]) -> list[Area]:
    """Those that are ranked: a levelled model's area is of another kind."""
    return [a for a in areas if not a.model.endswith(LEVELLED)]


def _not_told_apart(ranked: Sequence[Area], band: Band | None) -> Pairs:
    """Pairs, in order, of which neither is surely the nearer; all where nothing is known."""
    pairs = combinations([a.model for a in ranked], 2)
    return tuple((a, b) for a, b in pairs if band is None or not (band.surely_below(a, b) or band.surely_below(b, a)))


def _told(where: str, ranked: Sequence[Area], band: Band) -> str:
    """Which model is nearest, and which others the measurement cannot tell from it; nothing for one model.

    Of the others, neighbours in the order that are not told apart are named as well.
    """
    if len(ranked) < 2:
        return ""
    pairs = _not_told_apart(ranked, band)
    first, *others = (a.model for a in ranked)
    near = [b for a, b in pairs if a == first]
    alike = [f"{a} and {b}" for a, b in pairwise(others) if (a, b) in pairs]
    return (
        f"Nearest {where}, by the area: {first}. "
        + (
            f"The measurement does not tell these apart from it by the area: {', '.join(near)}."
            if near
            else "It is told apart from all others."
        )
        + (f" Further down, neighbours that it does not tell apart: {'; '.join(alike)}." if alike else "")
    )


def _shears(found: Mapped) -> dict[str, FloatArray]:
    """Maximal shear of each model, and that of none."""
    return {name: field.max_shear for name, field in found.models.items()} | {NOTHING: np.zeros(len(found.points_mm))}


def _bands(
    found: Mapped,
    tissues: Mapping[str, BoolArray],
    table: ErrorTable,
    strains: tuple[float, float],
    seed: int,
    first: list[FloatArray],
) -> dict[str, Band]:
    """Bands by tissue; the ``first`` truths drawn for them are kept."""
    common = found.common
    draws = TruthDraws(
        found.points_mm[common], found.measured.max_shear[common], [str(t).lower() for t in found.tissue[common]],
        found.to_bone_mm[common], table, seed,
    )  # fmt: skip

    def kept() -> Iterator[FloatArray]:
        for truth in draws.many(DRAWS):
            if len(first) < LOCATED:
                first.append(truth.astype(np.float32))
            yield truth

    return bands(
        kept(),
        {name: shear[common] for name, shear in _shears(found).items()},
        found.volumes_ml[common],
        {name: where[common] for name, where in tissues.items()},
        table.factor,
        draws.narrowed,
        strains,
    )
