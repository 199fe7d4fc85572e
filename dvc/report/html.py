"""Parts that all HTML pages share: templates, packed data, and the content security policy."""

import base64
import gzip
import hashlib
import re
from collections.abc import Callable, Sequence
from importlib.resources import files

import jinja2
from markupsafe import Markup, escape

_FEW = 18  # letters of a cell that stays on one line
_INTERVAL = re.compile(r"\([-−+.\d]+(?: to |–)[-−+.\d]+(?: ?[%A-Za-z]+[²³]?)?\)")


def stored(name: str) -> str:
    """The text of a file that comes with the package."""
    return (files("dvc.report") / "templates" / name).read_text(encoding="utf-8")


def template(name: str, **filters: Callable[..., object]) -> jinja2.Template:
    """A template that escapes all text and refuses what is not given, with filters of its own."""
    strict = jinja2.StrictUndefined
    environment = jinja2.Environment(autoescape=True, undefined=strict, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= filters
    return environment.from_string(stored(f"{name}.html.j2"))


def wrapping(cell: str) -> str:
    """Class of a table's cell by its text: "whole" for a few words, which stay on one line of a narrow page."""
    return "whole" if " " in cell and "(" not in cell and len(cell) <= _FEW else ""


def unbroken(cell: str) -> Markup:
    """The text of a cell whose intervals in brackets each stay on one line.

    >>> unbroken("0.72 (0.00 to 1.33)")
    Markup('0.72 <span class="whole">(0.00 to 1.33)</span>')
    >>> unbroken("3.0 mm (2.1 to 4.0 mm)")
    Markup('3.0 mm <span class="whole">(2.1 to 4.0 mm)</span>')
    """
    return Markup(_INTERVAL.sub(r'<span class="whole">\g<0></span>', str(escape(cell))))


def packed(content: bytes) -> str:
    """Compressed, in base64; equal contents give equal text."""
    return base64.b64encode(gzip.compress(content, mtime=0)).decode()


def policy(style: str, scripts: Sequence[str], *, viewer: bool = False) -> str:
    """Content security policy of a page: only its own scripts and style run, by their hashes, and nothing is fetched.

    A page with the 3-D ``viewer`` may also compile WebAssembly, and read what it has unpacked.
    """
    run = " ".join([*map(_hash, scripts), *(["'wasm-unsafe-eval'"] if viewer else [])])
    images, more = ("data: blob:", "; worker-src blob:; connect-src data: blob:") if viewer else ("data:", "")
    return (
        f"default-src 'none'; base-uri 'none'; form-action 'none'; img-src {images}; style-src {_hash(style)}; "
        f"script-src {run}{more}"
    )


def _hash(content: str) -> str:
    """A script or style of a page as its content security policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
