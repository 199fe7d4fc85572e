"""Charts of curves: a legend can be read whatever runs beneath it."""

from __future__ import annotations

import numpy as np

from dvc.report.chart import chart, legend, legend_above, panels


def test_no_line_runs_through_the_text_of_a_legend() -> None:
    """Of black lines in every second dot, those beneath the legend are at most a faint grey."""
    figure, (axes,) = chart()
    axes.vlines(np.linspace(0.0, 1.0, 200), 0.0, 1.0, color="black", linewidth=0.8)
    axes.plot([], [], color="white", label=" ")  # a key without anything dark in it
    legend(axes, loc="center")
    figure.canvas.draw()
    grey = np.asarray(figure.canvas.buffer_rgba())[::-1, :, :3].mean(axis=2)  # type: ignore[attr-defined]
    box = axes.get_legend().get_window_extent()  # type: ignore[union-attr]
    beneath = grey[int(box.y0) + 6 : int(box.y1) - 6, int(box.x0) + 6 : int(box.x1) - 6]
    beside = grey[int(box.y1) + 10 : int(box.y1) + 30, int(box.x0) : int(box.x1)]
    assert beside.min() < 100.0
    assert beneath.min() > 200.0


def test_a_legend_above_panels_hides_none_of_them() -> None:
    figure, spots = panels(4)
    for number in range(7):
        spots[0].plot([0.0, 1.0], [0.0, 1.0], label=f"model number {number}")
    legend_above(spots[0])
    figure.canvas.draw()
    (box,) = (one.get_window_extent() for one in figure.legends)
    assert all(box.y0 >= spot.get_tightbbox().y1 for spot in spots)  # type: ignore[union-attr]
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1
