"""The one place where a figure becomes files: PNG for the screen, PDF for a paper, CSV with the numbers in it."""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Self

import numpy as np
import numpy.typing as npt
from matplotlib import rc_context
from matplotlib.figure import Figure

from dvc.atomic_files import whole_file, write_csv
from dvc.report.page import Picture
from dvc.report.style import DPI

Columns = Mapping[str, Sequence[object] | npt.NDArray[np.generic]]
"""Numbers that a figure shows, by the names of their columns with their units."""
ENDINGS = (".png", ".pdf")
"""Of the files of every figure."""
_PRINT_DPI = 300  # of what is not drawn as lines; images keep their own voxels
_SETTINGS = Lock()  # matplotlib's are those of all threads


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A figure with its title and caption; ``data`` are the numbers in it that stand in no other file.

    On a page it fades to the figures ``beneath`` it, of the same size, each with its name. On a narrow screen a
    ``narrow`` figure takes its place.
    """

    title: str
    caption: str
    figure: Figure
    data: Columns | None = None
    beneath: tuple[tuple[str, Figure], ...] = ()
    narrow: Figure | None = None

    @classmethod
    def of(
        cls, title: str, draw: Callable[..., Figure], *shown: object, note: str = "", data: Columns | None = None
    ) -> Self:
        """The figure that ``draw`` makes of ``shown``; its docstring, which says how to read it, is the caption."""
        return cls(title, " ".join(f"{draw.__doc__ or ''} {note}".split()), draw(*shown), data)

    def save(self, stem: Path) -> Picture:
        """Write its files, as `save_figure`; the picture for a page."""
        return self._picture(save_figure(stem, self.figure, self.data))

    def picture(self) -> Picture:
        """The picture for a page, without a file."""
        return self._picture(png_bytes(self.figure))

    def _picture(self, png: bytes) -> Picture:
        beneath = tuple((name, png_bytes(one)) for name, one in self.beneath)
        narrow = b"" if self.narrow is None else png_bytes(self.narrow)
        return Picture(self.title, self.caption, png, beneath, narrow)


def save_figure(stem: Path, figure: Figure, data: Columns | None = None) -> bytes:
    """Write STEM.png, STEM.pdf, and STEM.csv if there are data; the PNG file's bytes. The figure is then used up.

    OutputError if a file cannot be written.
    """
    png = png_bytes(figure)
    for path, content in zip(figure_files(stem), (png, _pdf_bytes(figure)), strict=True):
        with whole_file(path) as part:
            part.write_bytes(content)
    if data is not None:
        write_csv(stem.with_name(f"{stem.name}.csv"), data, zip(*data.values(), strict=True))
    return png


def figure_files(stem: Path) -> list[Path]:
    """The names of a figure's pictures; a stem may have dots."""
    return [stem.with_name(stem.name + ending) for ending in ENDINGS]


def png_bytes(figure: Figure) -> bytes:
    """A figure as a PNG file's bytes; equal figures give equal bytes. Its parts keep their places from then on."""
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)  # each file would find the same places again, and draw the figure once more for it
        figure.set_layout_engine(None)
    return _drawn(figure)


def _drawn(figure: Figure) -> bytes:
    """A figure whose parts have their places as a PNG file's bytes."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    return file.getvalue()


def _pdf_bytes(figure: Figure) -> bytes:
    """A figure that was drawn before as a PDF file's bytes, without a date; equal figures give equal bytes.

    Its text is set in a TrueType font that the file holds, its lines are lines, and an image keeps its own voxels: the
    file is small, and as sharp as the data.
    """
    for axes in figure.axes:
        for image in axes.images:
            image.set_interpolation("none")
    file, undated = io.BytesIO(), dict.fromkeys(("Creator", "Producer", "CreationDate"))
    # By the second matplotlib decides whether one font will do.
    with _SETTINGS, rc_context({"pdf.fonttype": 42, "ps.fonttype": 42}):
        figure.savefig(file, format="pdf", dpi=_PRINT_DPI, metadata=undated)
    return file.getvalue()
