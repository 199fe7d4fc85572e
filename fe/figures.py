"""Figures of the finite-element side, each as PNG bytes; what a figure's docstring says is its caption."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dvc.figures import REGION_COLOURS
from dvc.sheet import chart, label_axes, png_bytes
from fe.fitting import Curve, Fit

_POINTS = 200


def stress_stretch(curves: Sequence[Curve], fitted: Fit) -> bytes:
    """Measured nominal stress (points) and the fitted law (lines), by kind of test.

    The line is dashed where Drucker's condition fails: a simulation that gets there is not to be trusted.
    """
    figure, (axes,) = chart()
    for number, curve in enumerate(curves):
        colour = REGION_COLOURS[number % len(REGION_COLOURS)]
        low, high = fitted.reached[curve.mode]
        margin = 0.05 * (high - low)
        stretch = np.linspace(low - margin, high + margin, _POINTS)
        stress = 1000.0 * fitted.material.nominal_stress(stretch, curve.mode)
        least, greatest = fitted.stable[curve.mode]
        stable = (stretch >= least) & (stretch <= greatest)
        axes.plot(stretch, np.where(stable, stress, np.nan), color=colour, linewidth=1.8, label=curve.mode)
        if not stable.all():
            axes.plot(stretch, np.where(stable, np.nan, stress), color=colour, linewidth=1.8, linestyle="--")
        axes.plot(curve.stretch, 1000.0 * curve.stress_mpa, "o", color=colour, markersize=4, markerfacecolor="white")
    axes.axhline(0.0, color="#9aa5b1", linewidth=0.8)
    label_axes(axes, "stretch", "nominal stress, kPa")
    axes.legend(fontsize=9, frameon=False)
    return png_bytes(figure)
