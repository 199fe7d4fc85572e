"""Figures of an accuracy study; the docstring of each is its caption."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dvc.report.chart import chart, label_axes, legend
from dvc.report.style import RULE, TISSUES, looks
from phantoms.error_tables import SOFT, ErrorRow, FloorRow, ResolutionRow, wavelength_recovered

_FEWEST = 200


def pooled_errors(rows: Sequence[ErrorRow], by: str) -> list[tuple[str, float, float, float]]:
    """Tissue, middle of a bin, and there root mean square error and bias of the max. shear, as they are drawn.

    All motions with strain together, weighted by their number of samples. The outermost bin is open and stands at one
    and a half times its lower limit; bins of fewer than 200 samples are left out.
    """
    pooled = []
    for tissue in SOFT:
        of_tissue = [r for r in rows if r.tissue == tissue and r.by == by and r.motion != "still"]
        for low in sorted({r.low for r in of_tissue}):
            of_bin = [r for r in of_tissue if r.low == low]
            weight = np.array([r.samples for r in of_bin], dtype=np.float64)
            if weight.sum() < _FEWEST:
                continue
            at = 0.5 * (low + of_bin[0].high) if np.isfinite(of_bin[0].high) else 1.5 * low
            rmse = float(np.sqrt(np.average([r.shear_rmse**2 for r in of_bin], weights=weight)))
            bias = float(np.average([r.shear_bias for r in of_bin], weights=weight))
            pooled.append((tissue, at, rmse, bias))
    return pooled


def errors_by_place(pooled: Sequence[tuple[str, float, float, float]], by: str) -> Figure:
    """Root mean square error (lines) and bias (dashes) of the max. shear over the middle of each bin, by tissue.

    All motions with strain together, weighted by their number of samples. The outermost bin is open and drawn at one
    and a half times its lower limit; bins of fewer than 200 samples are left out.
    """
    figure, (axes,) = chart()
    look = looks(SOFT, TISSUES)
    for tissue in dict.fromkeys(row[0] for row in pooled):
        at, rmse, bias = zip(*(row[1:] for row in pooled if row[0] == tissue), strict=True)
        axes.plot(at, rmse, label=tissue, **look[tissue].marked)
        axes.plot(at, bias, color=look[tissue].colour, linestyle="--", marker=".", linewidth=1.2)
    axes.axhline(0.0, color=RULE, linewidth=0.8)
    label_axes(axes, words(by), "error of the max. shear, no unit")
    legend(axes)  # a small study may have no bin that is large enough
    return figure


def words(by: str) -> str:
    """What errors are shown by, from its name in the tables."""
    return by.replace("a border", "a tissue interface")


def resolution(rows: Sequence[ResolutionRow]) -> Figure:
    """Fraction of a sinusoidal shear that is recovered, by wavelength; grey lines at 50 % and 90 %.

    Shear along the foot that varies through the thickness of the pad, at most 0.2; no rigid motion of the foot.
    """
    figure, (axes,) = chart(page_wide=True)
    conditions = list(dict.fromkeys(map(_of_tissue, rows)))
    for condition, look in looks(conditions, conditions).items():
        mine = sorted((r for r in rows if _of_tissue(r) == condition), key=lambda r: r.wavelength_mm)
        axes.plot([r.wavelength_mm for r in mine], [r.recovered for r in mine], label=condition, **look.marked)
    for share in (0.5, 0.9):
        axes.axhline(share, color=RULE, linewidth=0.8)
    axes.set_ylim(0.0, 1.1)
    axes.set_xlim(left=0.0)
    label_axes(axes, "wavelength of the strain, mm", "fraction recovered, no unit")
    legend(axes, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def noise_and_resolution(
    floors: Sequence[FloorRow], rows: Sequence[ResolutionRow], tissue: str
) -> list[tuple[str, float, float]]:
    """Condition, wavelength at which 90 % is recovered, mm, and median apparent max. shear without load."""
    known = []
    for condition in dict.fromkeys(map(_condition, rows)):
        mine = [r for r in rows if _condition(r) == condition and r.tissue == tissue]
        floor = [f.shear_p50 for f in floors if _condition(f) == condition and f.tissue == tissue]
        at = wavelength_recovered(mine, 0.9)
        if floor and np.isfinite(at):
            known.append((condition, at, floor[0]))
    return known


def trade_off(known: Sequence[tuple[str, float, float]], tissue: str) -> Figure:
    """Noise against spatial resolution; lower left is better.

    Noise is the median apparent max. shear of an unloaded pair, resolution the wavelength at which 90 % is recovered.
    """
    figure, (axes,) = chart(page_wide=True)
    conditions = [condition for condition, _, _ in known]
    look = looks(conditions, conditions)
    for condition, at, floor in known:
        axes.plot(at, floor, label=condition, **look[condition].marked | {"linestyle": "none", "markersize": 9})
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    label_axes(axes, "wavelength recovered to 90 %, mm", f"apparent max. shear without load,\n{tissue}, no unit")
    legend(axes, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _condition(row: ResolutionRow | FloorRow) -> str:
    return f"{row.preset}, {row.voxel_mm} mm, SNR {row.snr:g}"


def _of_tissue(row: ResolutionRow) -> str:
    return f"{row.tissue}: {_condition(row)}"
