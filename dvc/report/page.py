"""The building blocks of a report page: verdicts, tables, figures and volumes in one self-contained HTML file."""

import base64
import io
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Self

import nibabel
import numpy as np
import numpy.typing as npt
from PIL import Image as Pixels

from dvc.atomic_files import write_whole
from dvc.errors import InputError
from dvc.images.image import Grid
from dvc.report.alike import alike
from dvc.report.html import packed, policy, stored, template, unbroken, wrapping
from dvc.threads import usable_cores
from dvc.trust.verdict import Level, Verdict

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CSS_PIXELS_PER_DOT = 96 / 120  # figures are drawn at 120 dots per inch: text of 10 pt is then 10 pt on the page

_TONES: Mapping[Level | None, tuple[str, str]] = {
    "trust": ("#17693f", "#e9f5ee"), "caution": ("#8a5300", "#fdf3e0"), "distrust": ("#a91e17", "#fcebe9"),
    None: ("#0b5cad", "#f0f3f6"),
}  # fmt: skip
"""Colours of a notebook's headline and its ground, by the level of the verdict in it."""
_GREYS, _COLOURS = 24, 80  # steps of a volume's values: each takes room, of noise above all; a strain to .007 of .55
_BLACK = 2.5  # steps of an image: below, it is air
_QUALITY = 58  # of pictures on the page; files of figures lose nothing
_METHOD = 2  # of compression: 4 takes 2.5 times as long for 6 % less
# Pillow's errors where memory runs out: the encoder could not be loaded, or got none (VP8_ENC_ERROR_OUT_OF_MEMORY).
_NO_MEMORY = "'WEBP'", "encoding error 1"
_WHITE, _CHART_COLOURS = 0.5, 128  # a chart: so much of it is white, and so many colours are enough
_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
NIIVUE = "0.69.0"
"""Version of the viewer (WebGL 2, niivue.com) that comes with the package; it draws what the page itself holds."""
MEASUREMENT, WITH_MODELS = "Measurement", "Measurement and model files"
"""What a verdict is on: the measurement, or also the files of models, where there is something odd in them."""
LOPSIDED = (
    "Intervals are corrected for the known bias (noise raises low strains, smoothing lowers peaks), so the measured "
    "value need not lie in the middle."
)
"""In the note of a table with intervals of a measured strain."""
METHODS = "Methods text"
"""Title of a report's section with paragraphs for a methods section."""


@dataclass(frozen=True, slots=True)
class Banner:
    """A title and sentences below the verdict of a report: the second thing that a reader sees."""

    title: str
    paragraphs: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG figure (InputError for another) with what it shows and how to read it.

    A page fades from it to pictures ``beneath`` it, of the same size, each a name with a PNG file's bytes. On a narrow
    screen it shows the picture ``narrow``, if there is one, instead.
    """

    title: str
    caption: str
    png: bytes
    beneath: tuple[tuple[str, bytes], ...] = ()
    narrow: bytes = b""

    def __post_init__(self) -> None:
        if not self.png.startswith(_PNG_SIGNATURE):
            raise InputError(f"The figure '{self.title}' is not a PNG file; it begins with {self.png[:8]!r}.")

    @property
    def data(self) -> str:
        """The picture as it is, for an ``img`` element."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()

    @property
    def small(self) -> str:
        """The picture for an ``img`` element as WebP, in a third of the room."""
        return _small(self.png)

    @property
    def small_narrow(self) -> str:
        """The picture for a narrow screen, as `small`; empty without one."""
        return _small(self.narrow) if self.narrow else ""

    @property
    def small_beneath(self) -> list[tuple[str, str]]:
        """The pictures beneath it, each with its name; as `small`."""
        return [(name, _small(png)) for name, png in self.beneath]

    @property
    def alt(self) -> str:
        """Text for screen readers: its title, and the first sentence of the caption."""
        first = self.caption.partition(". ")[0].removesuffix(".")
        return f"{self.title}: {first}." if first else self.title

    @property
    def width(self) -> int:
        """Width on the page, CSS pixels."""
        return _width(self.png)

    @property
    def narrow_width(self) -> int:
        """Width on the page of the picture for a narrow screen."""
        return _width(self.narrow)


@dataclass(frozen=True, slots=True)
class Estimate:
    """A measured value and its interval of 95 % coverage, if that is known, all shown to three decimals.

    The eye then compares them down a column.

    >>> print(Estimate(0.4204), Estimate(0.131, (0.0301, 0.1391)), Estimate(float("nan")), sep=", ")
    0.420, 0.131 (0.030 to 0.139), –
    """

    value: float
    interval: tuple[float, float] | None = None

    @property
    def least(self) -> float:
        """Lower end of the interval; the value where that is not known."""
        low = self.value if self.interval is None else self.interval[0]
        return low if np.isfinite(low) else self.value

    def reaches(self, other: Self) -> bool:
        """Whether its interval overlaps with another one, or reaches its lower end; not where its own is not known."""
        return self.interval is not None and self.interval[1] >= other.least

    def __str__(self) -> str:
        value, *ends = (f"{n:z.3f}" if np.isfinite(n) else shown(n) for n in (self.value, *(self.interval or ())))
        return f"{value} ({' to '.join(ends)})" if ends else value


Cell = str | float | int | None | Estimate


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under named columns, one cell for each; numbers are shown to three digits, missing ones as a dash.

    Rows ``apart`` stand below a line: the others are to be seen beside them.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    apart: tuple[tuple[Cell, ...], ...] = ()

    def __post_init__(self) -> None:
        for number, row in enumerate((*self.rows, *self.apart)):
            if len(row) != len(self.columns):
                what = f"Row {number} of the table '{self.title}' has {len(row)} cells; the table has"
                raise InputError(f"{what} {len(self.columns)} columns.")

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Whether each column holds numbers and missing values alone, and is set flush right."""
        columns = zip(*self.rows, strict=True) if self.rows else ((),) * len(self.columns)
        return tuple(bool(column) and not any(isinstance(c, str | Estimate) for c in column) for column in columns)

    @property
    def texts(self) -> list[tuple[str, ...]]:
        """The cells of all rows, those apart last, as people read them; numbers of a column have digits alike.

        >>> Table("t", ("model", "area, mL"), (("a", 2.0), ("b", 3.83), ("c", 0.0), ("d", 120.4))).texts
        [('a', '2.00'), ('b', '3.83'), ('c', '0'), ('d', '120')]
        """
        columns = zip(*self.rows, *self.apart, strict=True)
        texts = [_alike(of) if number else map(shown, of) for of, number in zip(columns, self.numeric, strict=False)]
        return list(zip(*texts, strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """A volume as a page holds it; ``most`` is the value of the last colour.

    NIfTI of eight bits, each voxel less the one a row before it (``viewer.js`` adds them up), compressed, base64.
    """

    title: str
    data: str
    most: float

    @classmethod
    def image(cls, title: str, grid: Grid, values: npt.NDArray[np.floating], most: float) -> Self:
        """An MR image (ni, nj, nk), from 0 to ``most``, the value that is drawn white; NaN becomes 0.

        What is below a tenth of white is black: it is noise in the air, which would take most of the room.
        """
        return cls._of(title, grid, np.where(values < most * _BLACK / _GREYS, 0.0, values), most, _GREYS)

    @classmethod
    def overlay(cls, title: str, grid: Grid, values: npt.NDArray[np.floating], most: float) -> Self:
        """A scalar (ni, nj, nk) in colour, from 0 to ``most``; NaN becomes 0, which an overlay does not show."""
        return cls._of(title, grid, values, most, _COLOURS)

    @classmethod
    def _of(cls, title: str, grid: Grid, values: npt.NDArray[np.floating], most: float, steps: int) -> Self:
        known, step = np.nan_to_num(np.asarray(values, dtype=np.float64)), most / steps
        held = np.clip(np.rint(known / step), 0, 255).astype(np.uint8)
        in_file, row = held.ravel(order="F"), held.shape[0]
        in_file[row:] -= in_file[:-row].copy()
        image = nibabel.Nifti1Image(in_file.reshape(held.shape, order="F"), _TO_RAS @ grid.affine)
        image.header.set_slope_inter(step, 0.0)
        image.header["descrip"] = "each voxel less the one a row before it"  # results of older versions have none
        return cls(title, packed(image.to_bytes()), most)


@dataclass(frozen=True, slots=True, eq=False)
class Viewer:
    """An image, and scalars in colour over it, each on a canvas of its own; they turn and scroll together."""

    title: str
    caption: str
    image: Volume
    overlays: tuple[Volume, ...]


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report with its own verdict, or without one; a reader opens a ``folded`` one where it is wanted."""

    title: str
    verdict: Verdict | None = None
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    paragraphs: tuple[str, ...] = ()
    viewers: tuple[Viewer, ...] = ()
    folded: bool = False
    pictures_first: bool = False  # before the tables, and all but the first two paragraphs (below a banner, all)
    summary: Table | None = None  # its first table, which a report of many sections also begins with
    caveat: str = ""  # a sentence in the note of that table, which stands below that beginning, too


def shown(value: Cell) -> str:
    """A table cell as people read it.

    >>> [shown(v) for v in (0.123456, 1234.5, 12, 0.00001, float("nan"), None, "fat")]
    ['0.123', '1234', '12', '0.0000', '–', '–', 'fat']
    """
    if isinstance(value, float | np.floating) and np.isfinite(value):
        return f"{value:z.4f}" if 0.0 < abs(value) < 1e-4 else f"{value:z.0f}" if abs(value) >= 100 else f"{value:z.3g}"
    return "–" if value is None or isinstance(value, float | np.floating) else str(value)


def _alike(column: Sequence[Cell]) -> list[str]:
    """Numbers of a column as `shown` writes them, with zeros at the end where others have more digits, up to three."""
    texts = [shown(cell) for cell in column]
    decimals = max((len(text.partition(".")[2]) for text in texts), default=0)
    for place, (cell, text) in enumerate(zip(column, texts, strict=True)):
        if isinstance(cell, float | np.floating) and np.isfinite(cell) and (value := float(text)):
            whole = int(np.floor(np.log10(abs(value)))) + 1  # digits before the point; below 0.1, zeros after it
            texts[place] = text if abs(value) <= 1e-4 else f"{value:.{max(0, min(decimals, 3 - whole))}f}"
    return texts


def record_lines(record: Mapping[str, object]) -> dict[str, str]:
    """A provenance record as lines of a report: parts of it, and parts of these, each have their own."""
    lines: dict[str, str] = {}
    for name, value in record.items():
        for key, item in value.items() if isinstance(value, Mapping) else [("", value)]:
            nested = isinstance(item, Mapping) and all(isinstance(one, Mapping) for one in item.values())
            deeper: Any = item if nested else {}
            for part, one in (deeper or {"": item}).items():
                lines[": ".join(filter(None, (name, key, part)))] = _line(one)
    return lines


def _line(value: object) -> str:
    if value in (None, [], {}, ()):
        return "not given"
    if isinstance(value, Mapping):
        given = (f"{name}: {_line(one)}" for name, one in value.items() if one not in (None, [], {}, ()))
        return "; ".join(given) or "not given"
    if isinstance(value, list | tuple):
        if isinstance(value[0], Mapping):
            return "\n".join(", ".join(str(one) for one in item.values()) for item in value)
        if isinstance(value[0], list | tuple):
            return ", ".join(f"({_line(one)})" for one in value)
        return ", ".join(map(_line, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _width(png: bytes) -> int:
    return round(int.from_bytes(png[16:20], "big") * _CSS_PIXELS_PER_DOT)


@lru_cache(maxsize=256)
def _small(png: bytes) -> str:
    """The picture as WebP: as a photograph, or, where that is smaller, a chart in a few colours, which stays sharp."""
    with Pixels.open(io.BytesIO(png)) as picture:
        pixels = picture.convert("RGB")
    files = [_webp(pixels, quality=_QUALITY)]
    if pixels.convert("L").histogram()[-1] > _WHITE * pixels.width * pixels.height:
        # by colours, not by pixels: a mark of few pixels keeps its own
        few = pixels.quantize(_CHART_COLOURS, Pixels.Quantize.MAXCOVERAGE, dither=Pixels.Dither.NONE)
        files.append(_webp(few.convert("RGB"), lossless=True))
    return "data:image/webp;base64," + base64.b64encode(min(files, key=len)).decode()


def _webp(pixels: Pixels.Image, **how: Any) -> bytes:
    file = io.BytesIO()
    try:
        pixels.save(file, "WEBP", method=_METHOD, **how)
    except (KeyError, ValueError) as failure:
        if str(failure) not in _NO_MEMORY:
            raise
        raise MemoryError(f"A picture could not be encoded ({failure}).") from failure
    return file.getvalue()


@cache
def _library() -> Mapping[str, str]:
    """The viewer: its library, and the same compressed, which a page unpacks and runs when a viewer is asked for."""
    code = stored("niivue.umd.js")
    notice = f"/* niivue {NIIVUE}\n{stored('niivue-LICENSE.txt')}*/\n"
    return {"code": code, "packed": packed(code.encode()), "script": notice + stored("viewer.js")}


def write_report(
    path: Path,
    title: str,
    verdict: Verdict | None,
    sections: Sequence[Section],
    closing: Sequence[Section],
    provenance: Mapping[str, str],
    *,
    judged: str = MEASUREMENT,
    answer: str = "",
    models: Banner | None = None,
    notes: Sequence[str] = (),
    reload_s: int | None = None,
) -> None:
    """Write a report: verdict first, if there is one, then the sections, the closing ones, and where it all came from.

    The verdict is on what is ``judged``; the ``answer``, a sentence, stands beside it, unless it is "Do not trust".
    What there is to say of ``models`` stands below it. One HTML file without anything to fetch. All text is escaped,
    and a browser runs no script but those of this package. With two sections or more a list of them, with their
    verdicts, stands beside them. ``notes``, a line each, stand below the verdict. Closing sections and provenance are
    folded. A browser loads a page anew every ``reload_s`` seconds. OutputError if the file cannot be written.
    """
    told = {"title": title, "judged": judged, "verdict": verdict, "answer": answer, "models": models, "notes": notes}
    volumes: dict[str, str] = {}  # each once, however many viewers show it
    for viewer in (viewer for section in sections for viewer in section.viewers):
        for volume in (viewer.image, *viewer.overlays):
            volumes.setdefault(volume.data, f"volume-{len(volumes) + 1}")
    pictures = [picture for section in (*sections, *closing) for picture in section.pictures]
    with ThreadPoolExecutor(usable_cores()) as pool:  # which the template then finds done
        each = (png for one in pictures for png in (one.png, one.narrow, *(png for _, png in one.beneath)) if png)
        list(pool.map(_small, each))
    style, script, library = stored("page.css"), stored("page.js"), _library() if volumes else None
    scripts = [script, library["script"], library["code"]] if library else [script]
    page = template("report", alike=alike, unbroken=unbroken, wrapping=wrapping).render(
        **told, sections=sections, closing=closing, provenance=provenance, volumes=volumes, style=style, script=script,
        library=library, policy=policy(style, scripts, viewer=bool(volumes)), reload_s=reload_s, beneath={},
    )  # fmt: skip
    write_whole(path, page)


def notebook_html(
    headline: str, picture: Picture, table: Table, *, verdict: Verdict | None = None, notes: Sequence[str] = ()
) -> str:
    """What a notebook shows of a result: a headline with the verdict, if there is one, a picture, a table, notes."""
    told = {"headline": headline, "picture": picture, "table": table, "verdict": verdict, "notes": notes}
    return template("notebook").render(**told, tones=_TONES)
