"""How figures are drawn in tests: `make test` makes them all and draws none, except where a test looks at pictures.

Every chart that a test makes is searched for lines that are too pale on white.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.typing import ColorType
from PIL import Image as Pixels

from dvc.report import drawing


@contextmanager
def _pictures(
    drawn: Callable[[Figure], bytes], pdf: Callable[[Figure], bytes], layout: Callable[..., None]
) -> Iterator[None]:
    def checked(figure: Figure) -> bytes:
        assert not pale_lines(figure), pale_lines(figure)
        return drawn(figure)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "_drawn", checked)
        patch.setattr(drawing, "_pdf_bytes", pdf)
        patch.setattr(ConstrainedLayoutEngine, "execute", layout)
        yield


def _blank(figure: Figure) -> bytes:
    """A small white picture of a figure's shape."""
    width, height = figure.get_size_inches()
    file = io.BytesIO()
    Pixels.new("RGB", (round(30 * width), round(30 * height)), "white").save(file, "PNG")
    return file.getvalue()


blank_pictures = partial(_pictures, _blank, lambda _: b"%PDF-", lambda *_: None)
real_pictures = partial(_pictures, drawing._drawn, drawing._pdf_bytes, ConstrainedLayoutEngine.execute)
"""As users get them; drawing takes a third of the time of a small registration, and most of a comparison's."""


LEAST_CONTRAST = 3.0
"""Of a line beside its ground: WCAG 2.2, 1.4.11 (AA)."""


def contrast_on_white(colour: ColorType) -> float:
    """From 1 to 21, after WCAG 2.2; what is transparent lets white through."""
    *rgb, opaque = to_rgba(colour)
    seen = opaque * np.array(rgb) + 1.0 - opaque
    linear = np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4)
    return float(1.05 / (linear @ (0.2126, 0.7152, 0.0722) + 0.05))


def pale_lines(figure: Figure) -> list[str]:
    """Lines of the charts in a figure whose colour is too near to white; grids and pictures are left out."""
    found = []
    for axes in figure.axes:
        if axes.images or not axes.axison:
            continue
        lines = [line for line in axes.get_lines() if line.get_linestyle() != "None" or line.get_marker() != "None"]
        bundles = [one for one in axes.collections if isinstance(one, LineCollection)]
        colours = [_seen(line) for line in lines] + [tuple(rgba) for one in bundles for rgba in one.get_colors()]
        found += [f"{axes.get_title()}: {c}" for c in colours if contrast_on_white(c) < LEAST_CONTRAST]
    return found


def _seen(line: Line2D) -> ColorType:
    return to_rgba(line.get_color(), line.get_alpha())
