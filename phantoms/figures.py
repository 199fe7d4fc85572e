"""Figures of an accuracy study, each as PNG bytes; the docstring of each function is the caption."""

from collections.abc import Sequence

import numpy as np

from dvc.report.figures import REGION_COLOURS
from dvc.report.sheet import INK, chart, label_axes, png_bytes
from phantoms.error_tables import SOFT, ErrorRow, FloorRow, ResolutionRow, wavelength_recovered

_MARKS = ("o", "s", "^", "D", "v", "P")


def errors_by_place(rows: Sequence[ErrorRow], by: str) -> bytes:
    """Root mean square error (lines) and bias (dashes) of the max. shear over the middle of each bin, by tissue.

    All motions with strain together, weighted by their number of samples. The outermost bin is open and drawn at one
    and a half times its lower limit; bins of fewer than 200 samples are left out.
    """
    figure, (axes,) = chart(1)
    for number, tissue in enumerate(SOFT):
        of_tissue = [r for r in rows if r.tissue == tissue and r.by == by and r.motion != "still"]
        at, rmse, bias = [], [], []
        for low in sorted({r.low for r in of_tissue}):
            of_bin = [r for r in of_tissue if r.low == low]
            weight = np.array([r.samples for r in of_bin], dtype=np.float64)
            if weight.sum() < 200:
                continue
            at.append(0.5 * (low + of_bin[0].high) if np.isfinite(of_bin[0].high) else 1.5 * low)
            rmse.append(float(np.sqrt(np.average([r.shear_rmse**2 for r in of_bin], weights=weight))))
            bias.append(float(np.average([r.shear_bias for r in of_bin], weights=weight)))
        if at:
            axes.plot(at, rmse, color=REGION_COLOURS[number], marker=_MARKS[number], linewidth=1.8, label=tissue)
            axes.plot(at, bias, color=REGION_COLOURS[number], linestyle="--", marker=".", linewidth=1.2)
    axes.axhline(0.0, color="#9aa5b1", linewidth=0.8)
    label_axes(axes, words(by), "error of the max. shear")
    if axes.get_legend_handles_labels()[0]:  # a small study may have no bin that is large enough
        axes.legend(fontsize=9, frameon=False)
    return png_bytes(figure)


def words(by: str) -> str:
    """What errors are shown by, from its name in the tables."""
    return by.replace("a border", "a tissue interface")


def resolution(rows: Sequence[ResolutionRow]) -> bytes:
    """Fraction of a sinusoidal shear that is recovered, by wavelength; grey lines at 50 % and 90 %.

    Shear along the foot that varies through the thickness of the pad, at most 0.2; no rigid motion of the foot.
    """
    figure, (axes,) = chart(1)
    for number, condition in enumerate(dict.fromkeys(_of_tissue(r) for r in rows)):
        mine = sorted((r for r in rows if _of_tissue(r) == condition), key=lambda r: r.wavelength_mm)
        axes.plot(
            [r.wavelength_mm for r in mine], [r.recovered for r in mine], label=condition, linewidth=1.8,
            color=REGION_COLOURS[number % len(REGION_COLOURS)], marker=_MARKS[number % len(_MARKS)],
        )  # fmt: skip
    for share in (0.5, 0.9):
        axes.axhline(share, color="#9aa5b1", linewidth=0.8)
    axes.set_ylim(0.0, 1.1)
    axes.set_xlim(left=0.0)
    label_axes(axes, "wavelength of the strain, mm", "fraction recovered")
    axes.legend(fontsize=9, frameon=False)
    return png_bytes(figure)


def trade_off(floors: Sequence[FloorRow], rows: Sequence[ResolutionRow], tissue: str) -> bytes:
    """Noise against spatial resolution; lower left is better.

    Noise is the median apparent max. shear of an unloaded pair, resolution the wavelength at which 90 % is recovered.
    """
    figure, (axes,) = chart(1)
    for number, condition in enumerate(dict.fromkeys(_condition(r) for r in rows)):
        mine = [r for r in rows if _condition(r) == condition and r.tissue == tissue]
        floor = [f.shear_p50 for f in floors if _condition(f) == condition and f.tissue == tissue]
        at = wavelength_recovered(mine, 0.9)
        if floor and np.isfinite(at):
            colour = REGION_COLOURS[number % len(REGION_COLOURS)]
            axes.plot(at, floor[0], color=colour, marker=_MARKS[number % len(_MARKS)], markersize=9)
            axes.annotate(
                condition, (at, floor[0]), xytext=(-8, 8), textcoords="offset points", ha="right", fontsize=9, color=INK
            )
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    label_axes(axes, "wavelength recovered to 90 %, mm", f"apparent max. shear\nwithout load, {tissue}")
    return png_bytes(figure)


def _condition(row: ResolutionRow | FloorRow) -> str:
    return f"{row.preset}, {row.voxel_mm} mm, SNR {row.snr:g}"


def _of_tissue(row: ResolutionRow) -> str:
    return f"{row.tissue}: {_condition(row)}"
