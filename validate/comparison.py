"""One load, measured and simulated by several models: every figure of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.deformation import Deformation
from dvc.image import LabelMap
from dvc.mesh import TetMesh
from dvc.uncertainty import ErrorTable, TruthDraws
from validate.agreement import Agreement, Travel, agreements, travel
from validate.curves import RANGE, Area, Band, area_between, bands
from validate.location import LEAST_ML, Overlap, Threshold, neighbours, overlap
from validate.mapping import Mapped, mapped
from validate.sources import FeResult

ALL = "soft tissue"
"""All tissue that is compared, together."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Models against the measurement, under one load.

    Attributes
    ----------
    load : str
    found : Mapped
    areas : tuple of Area
        By model and tissue; that of all soft tissue first.
    overlaps : tuple of Overlap
    agreements : tuple of Agreement
    travels : tuple of Travel
    bands : mapping of tissue to Band
        Empty where the measurement's error is not known.
    """

    load: str
    found: Mapped
    areas: tuple[Area, ...]
    overlaps: tuple[Overlap, ...]
    agreements: tuple[Agreement, ...]
    travels: tuple[Travel, ...]
    bands: Mapping[str, Band]

    def ranked(self, tissue: str = ALL) -> list[Area]:
        """Areas of a tissue, the smallest first."""
        return sorted((a for a in self.areas if a.tissue == tissue), key=lambda a: a.ml)

    def within_noise(self, model: str, other: str, tissue: str = ALL) -> bool:
        """Whether the measurement cannot tell which of two models is nearer; also where its error is not known."""
        if tissue not in self.bands:
            return True
        band = self.bands[tissue]
        return not (band.surely_below(model, other) or band.surely_below(other, model))


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
        Of the truths drawn.

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
    told = _bands(found, tissues, table, strains, seed)
    areas = []
    for name, field in found.models.items():
        for tissue, where in tissues.items():
            volumes = found.volumes_ml[where]
            area = area_between(found.measured.max_shear[where], field.max_shear[where], volumes, strains)
            low, high = told[tissue].interval(name) if tissue in told else (np.nan, np.nan)
            areas.append(Area(name, load, tissue, area, area / volumes.sum() / (strains[1] - strains[0]), low, high))
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
    rows = [row for name in models for row in agreements(found, name, load)]
    travels = [travel(found, r.name, load, r.deformation, measured, normal) for r in results]
    return Comparison(load, found, tuple(areas), tuple(overlaps), tuple(rows), tuple(travels), told)


def _bands(
    found: Mapped, tissues: Mapping[str, BoolArray], table: ErrorTable | None, strains: tuple[float, float], seed: int
) -> dict[str, Band]:
    if table is None:
        return {}
    common = found.common
    draws = TruthDraws(
        found.points_mm[common], found.measured.max_shear[common], [str(t).lower() for t in found.tissue[common]],
        found.to_bone_mm[common], table, seed,
    )  # fmt: skip
    return bands(
        draws,
        {name: field.max_shear[common] for name, field in found.models.items()},
        found.volumes_ml[common],
        {name: where[common] for name, where in tissues.items()},
        1.0 if np.isnan(table.widening) else table.widening,
        strains,
    )
