"""How figures are drawn in tests: `make test` draws coarsely and no PDF, except where a test looks at pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest
from matplotlib.figure import Figure

from dvc.report import drawing


@contextmanager
def _drawn(dots_per_inch: int, pdf: Callable[[Figure], bytes]) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "DPI", dots_per_inch)
        patch.setattr(drawing, "_pdf_bytes", pdf)
        yield


coarse_pictures = partial(_drawn, 30, lambda _: b"")
real_pictures = partial(_drawn, drawing.DPI, drawing._pdf_bytes)
"""As users get them; drawing takes a third of the time of a small registration, and most of a comparison's."""
