"""The error bars of a registered load: its preset's error model applied to its strain map."""

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.file_names import as_typed
from dvc.images.bone_names import is_bones_name
from dvc.images.depth import to_surface_mm
from dvc.images.image import Grid, Mask
from dvc.measurement.subject import Subject
from dvc.registration.register import Registration
from dvc.trust.components import ComponentUncertainty, components_of
from dvc.trust.error_model import POOLED, ErrorModel, ErrorTable, error_model_of
from dvc.trust.field_draws import FieldDraws, TrueField
from dvc.trust.gaps import without_gaps
from dvc.trust.twin_judgement import Judged, judged
from dvc.trust.uncertainty import Interval, Uncertainty, uncertainty_of, widened

_MOSTLY = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class ErrorBars:
    """Error bars of a load's maximum shear strain, or the reason why there are none."""

    uncertainty: Uncertainty | None
    explanation: str  # where they come from, or why there are none; empty if no images were registered
    model: ErrorModel | None = None  # with the one table that was used
    twin: tuple[Judged, ...] = ()  # how the shear came back from the pair's twin, by tissue
    of_twin: str = ""  # what that did to the error bars
    beyond: str = ""  # how far the images are from those of the error model, if they are far

    @property
    def sigma(self) -> Float32Array | None:
        """See `Uncertainty`; None without error bars."""
        return None if self.uncertainty is None else self.uncertainty.sigma

    @property
    def bias(self) -> Float32Array | None:
        """See `Uncertainty`; None without error bars, and in results of older versions."""
        return None if self.uncertainty is None else self.uncertainty.bias

    @property
    def intervals(self) -> tuple[Interval, ...]:
        """See `Uncertainty`; empty without error bars."""
        return () if self.uncertainty is None else self.uncertainty.intervals

    @property
    def components(self) -> ComponentUncertainty | None:
        """See `Uncertainty`; None without error bars for components."""
        return None if self.uncertainty is None else self.uncertainty.components

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        told: dict[str, object] = {"known": False, "reason": self.explanation}
        if self.uncertainty is not None:
            voxel, snr = self.uncertainty.table.spacing_mm.tolist(), round(self.uncertainty.table.snr, 1)
            told = {"known": True, "source": self.explanation, "voxel_mm": voxel, "snr": snr}
        if self.twin or self.of_twin:
            told |= {"twin": [asdict(row) for row in self.twin], "of_twin": self.of_twin}
        return told | ({"beyond": self.beyond} if self.beyond else {})

    @classmethod
    def from_dict(cls, told: Mapping[str, Any], uncertainty: Uncertainty | None, model: ErrorModel | None) -> Self:
        """The error bars that `as_dict` gave, with their arrays."""
        twin = tuple(Judged(**row) for row in told.get("twin", ()))
        words = str(told.get("source", told.get("reason", "")))
        return cls(uncertainty, words, model, twin, told.get("of_twin", ""), told.get("beyond", ""))

    def draws(self, maps: StrainMaps, count: int, seed: int) -> Iterator[TrueField]:
        """Draw true fields of a measurement, one after the other; InputError where its errors are not known."""
        if count < 1:
            raise InputError(f"The number of draws must be 1 or more; got {count}.")
        sure = self._known("True fields cannot be drawn")
        if sure.to_bone_mm is None:
            raise InputError(
                "True fields cannot be drawn from results of an older version. Register these images again."
            )
        draws = FieldDraws(maps, sure.regions, sure.to_bone_mm, sure.table, seed=seed, wider=_wider(self.twin))
        return (draws.drawn() for _ in range(count))

    def interval_of(self, values: Sequence[float], tissue: str) -> tuple[float, float, float]:
        """95 % interval of a statistic of the maximum shear strain in one tissue, from its values in true fields drawn.

        The 2.5th and 97.5th percentile, moved away from the median by the factor of the tissue, as those of
        `Uncertainty.intervals`. The factor was found for percentiles and volumes above a strain; for components of the
        strain and for the displacement none is known.

        Parameters
        ----------
        values : sequence of float
            The statistic in each of the fields of `Measurement.draws`; 100 or more for steady ends.
        tissue : str
            Whose voxels it was computed from; "soft tissue" for several tissues together.

        Returns
        -------
        low, median, high : float
            No end is below zero, as no percentile or volume is.

        Raises
        ------
        InputError
            Without error bars, or if the tissue is not in the measurement or has no intervals.
        """
        sure = self._known("There is no interval")
        names = dict.fromkeys((*sure.regions, POOLED))
        if tissue.lower() not in {name.lower() for name in names}:
            raise InputError(f"Unknown tissue '{tissue}'; choose one of {', '.join(names)}.")
        if any(np.isnan(i.low) for i in sure.intervals if i.region.lower() == tissue.lower()):
            raise InputError(f"{tissue} has no interval. {self.explanation}")
        low, median, high = widened(np.asarray(values, dtype=np.float64)[:, None], sure.table.factor_of(tissue))
        return float(low[0]), float(median[0]), float(high[0])

    def _known(self, lacking: str) -> Uncertainty:
        if self.uncertainty is None:
            raise InputError(f"{lacking}, because there are no error bars. {self.explanation}")
        return self.uncertainty

    @property
    def summary(self) -> list[str]:
        """Why there are none, if images were registered; whether they are far from their images; the twin; in lines."""
        lines = [f"No error bars: {self.explanation}"] * bool(self.uncertainty is None and self.explanation)
        lines += [self.beyond] * bool(self.beyond)
        return lines + [f"Error bars: {self.of_twin}"] * bool(self.of_twin)


NO_ERROR_BARS = ErrorBars(None, "A repeat scan has no error bars: all of its apparent strain is error.")
"""Those of a repeat scan."""


@dataclass(frozen=True, slots=True, eq=False)
class TwinCheck:
    """What came back from the pair's twin, a synthetic warp of the unloaded image, or why nothing did."""

    max_shear: Float32Array | None  # (ni, nj, nk) on the unloaded image's grid; NaN where not defined
    failure: str = ""


def error_bars(
    found: Registration, subject: Subject, maps: StrainMaps, model: ErrorModel | None, twin: TwinCheck | None = None,
) -> ErrorBars:  # fmt: skip
    """Error of a registered load's maximum shear strain, by an error model, the user's own or the preset's.

    That model's figures are taken at the lower signal-to-noise ratio of the two images. Error bars that do not hold in
    the pair's twin are made wider.
    """
    grid = maps.grid
    larger, model = _larger_voxel(found), model or error_model_of(found.settings.engine.name)
    bone, regions = _bone_and_tissues(subject, found.tissue.inside, model)
    try:
        chosen = _model_for(found, model)
        snr = min(one.snr for one in found.noise if one is not None)
        table = chosen.table_for(larger, snr)
        if not bone.any():
            raise InputError("The error model needs the distance to bone, but no bone was given.")
    except InputError as reason:
        again = None if twin is None else twin.max_shear
        rows = () if again is None else judged(maps.max_shear, again, regions)
        return ErrorBars(None, str(reason), twin=rows, of_twin=_of_twin(rows, twin))
    to_bone, seed, rows = _to_bone_mm(bone, regions, grid), found.settings.seed, tuple[Judged, ...]()
    if twin is not None and twin.max_shear is not None:
        again = np.where(np.isfinite(maps.max_shear), twin.max_shear, np.float32(np.nan))
        of_twin = uncertainty_of(again, grid, regions, to_bone, table, seed=seed)
        rows = judged(maps.max_shear, again, regions, to_bone, of_twin, grid.voxel_volume_mm3)
    wider = _wider(rows)
    sure = uncertainty_of(maps.max_shear, grid, regions, to_bone, table, seed=seed, wider=wider)
    sure = replace(sure, components=components_of(maps, regions, to_bone, table, wider))
    sure, gaps = without_gaps(sure, chosen.preset, labels_from_image=subject.from_image is not None)
    known = ", ".join(name for name in regions if name in table.whole and name != POOLED)
    own_errors = f"Errors were measured for {known}; other tissues use" if known else "All tissues use"
    voxel, own = (" x ".join(f"{s:.2g}" for s in sorted(edges)) for edges in (table.spacing_mm, larger))
    other = "" if own == voxel else f" (these images: voxels of {own} mm)"
    told = (
        f"Error model of {chosen.preset}, its table for voxels of {voxel} mm at SNR {table.snr:.0f}{other}: "
        f"{_in_words(chosen.source)}. {own_errors} the pooled errors of soft tissue. {_held(table)} The model applies "
        "to tissue that is strained and imaged like these phantoms; elsewhere no coverage is guaranteed."
    )
    told = " ".join((told, *gaps))
    used, beyond = _used(chosen, table, wider), table.beyond(larger, snr, chosen.preset)
    return ErrorBars(sure, told, used, rows, _of_twin(rows, twin), beyond)


_WORDS = {
    r", seeds \[[^]]*\]": "",
    r"attached-(\w+)": r"\1 with tissue attached to bone",
    r", bones and skin in (label maps[\w ]*) too large by -1, \+0, \+1 voxels": r", with bones and skin in \1 drawn "
    "exactly, or one voxel too small or too large",
    r"widened by (\d+) pairs that finite-element models move": r"widened by factors from \1 image pairs moved by "
    "finite-element models",
}


def _in_words(source: str) -> str:
    """What an error model was measured on, without what only repeats it, and with motions in words.

    >>> _in_words("54 registrations of phantom heels, seeds [9000, 9001], motions Load1, attached-Load1")
    '54 registrations of phantom heels, motions Load1, Load1 with tissue attached to bone'
    """
    for found, words in _WORDS.items():
        source = re.sub(found, words, source)
    return source


def _wider(rows: Sequence[Judged]) -> dict[str, float]:
    """Factors on the error bars of tissues that did not hold in the twin."""
    return {row.region: row.factor for row in rows if row.factor is not None and row.factor > 1.0}


def _to_bone_mm(bone: BoolArray, tissues: Mapping[str, BoolArray], grid: Grid) -> Float32Array:
    """Distance (mm) to bone in the tissues; infinite beyond the box of both, which may be a third of the image."""
    box = Mask(grid, np.logical_or.reduce([bone, *tissues.values()])).box(1)
    distance = np.full(grid.shape, np.inf, dtype=np.float32)
    distance[box] = to_surface_mm(bone[box], grid.spacing_mm)
    return distance


def _used(chosen: ErrorModel, table: ErrorTable, wider: Mapping[str, float]) -> ErrorModel:
    """The error model with the one table that was used, as wide as its least certain tissue, for comparing models."""
    if not wider:
        return replace(chosen, tables=(table,))
    most = max(wider.values())
    widened = f"intervals widened {most:.1f} times by the synthetic warp of one pair, and valid for that pair alone"
    source = f"{chosen.source}; {widened}"
    of_tissue = {name: most * factor for name, factor in table.widening_of.items()}
    return replace(chosen, tables=(replace(table, widening=most * table.factor, widening_of=of_tissue),), source=source)


def _of_twin(rows: Sequence[Judged], twin: TwinCheck | None) -> str:
    """What the pair's twin did to the error bars, or why there is none; empty where none was asked for."""
    if twin is not None and twin.failure:
        return f"not checked, because the synthetic warp of this pair has no result. {twin.failure}"
    if not rows:
        return ""
    if all(row.factor is None for row in rows):
        errors = ", ".join(f"{row.region} {row.rms_error:.3f}" for row in rows)
        return f"not known. In the synthetic warp of this pair, the error (rms) of the max. shear is {errors}."
    some = ", ".join(f"{row.region} {row.factor:.1f} times" for row in rows if row.factor and row.factor > 1.0)
    return f"{'widened' if some else 'confirmed'} by the synthetic warp of this pair{f': {some}' if some else ''}."


def _held(table: ErrorTable) -> str:
    if not np.isfinite(table.widening):
        return "The coverage of these intervals is not known: the error model rests on a single registration."
    factors = {f"{factor:.1f}" for factor in (table.widening_of or {"": table.factor}).values()}
    times = " to ".join(dict.fromkeys((min(factors, key=float), max(factors, key=float))))
    share, where, whole = "95 %", "the parts of the study left out", ""
    if table.widening_of:
        share, where = "97 % (95 % and a margin for other motions)", "image pairs moved by finite-element models"
        whole = f" (all soft tissue: {table.factor:.1f})"
    return f"Intervals are widened by a factor of {times}{whole}, to contain {share} of the true values in {where}."


def _model_for(found: Registration, given: ErrorModel | None) -> ErrorModel:
    """The error model of the engine that was used; InputError with the reason where there is none."""
    used = found.settings.engine
    if used.without_error_model:
        raise InputError(used.without_error_model)
    measure = f"`mrstrain accuracy --preset {as_typed(used.name)}`"
    if given is None:
        raise InputError(f"The error of {used.name} has not been measured. Measure it with {measure}.")
    if given.preset != used.name:
        both = f"The error model is for {given.preset}, but the images were registered with {used.name}"
        raise InputError(f"{both}. Measure its error with {measure}.")
    if given.parameters_sha256 != hashlib.sha256(used.text.encode()).hexdigest():
        raise InputError(used.unlike_its_error_model)
    if found.unlike_study:
        raise InputError(found.unlike_study)
    return given


def _larger_voxel(found: Registration) -> FloatArray:
    """The larger voxel of the two images, edge by edge, mm."""
    return np.maximum(np.sort(found.reference.grid.spacing_mm), np.sort(found.loaded.grid.spacing_mm))


def _bone_and_tissues(
    subject: Subject, tissue: BoolArray, model: ErrorModel | None
) -> tuple[BoolArray, Mapping[str, BoolArray]]:
    """Every bone that is known, and the soft tissues by name."""
    known = set() if model is None else set(model.tables[0].whole)
    bone = np.zeros(tissue.shape, dtype=bool) if subject.bone is None else subject.bone.inside.copy()
    soft: dict[str, BoolArray] = {}
    if subject.labels is not None:
        for number, name in subject.labels.names.items():
            inside = subject.labels.labels == number
            count = np.count_nonzero(inside)
            if is_bones_name(name) or (count and np.count_nonzero(inside & bone) > _MOSTLY * count):
                bone |= inside
            elif count:
                soft[name.lower() if name.lower() in known else name] = inside
    if not soft:
        soft = {POOLED: tissue & ~bone}
    return bone, {name: inside & ~bone for name, inside in soft.items()}
