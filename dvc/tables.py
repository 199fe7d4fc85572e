"""Tables that a person or another program wrote, CSV with a header line and decimal points; files cut within a line."""

import csv
import re
from pathlib import Path

from dvc.errors import InputError

_CUT = "the file may be incomplete: it ends in the middle of a line. If not, add a line break at its end."


def read_text(path: Path) -> str:
    """The text of a file; InputError if it is missing or no text in UTF-8."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({getattr(error, 'strerror', None) or error}).") from error


def read_table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of the columns, in lower case, and each row's line and cells, as many as there are columns.

    Blanks around a cell are left out, as are blank lines and those that begin with #. An empty file has no columns.

    Raises
    ------
    InputError
        If the file cannot be read, columns are separated by semicolons, or a row is incomplete: it has fewer cells than
        the header, more cells that are not empty, a quote that does not end, or no line break.
    """
    lines = ("" if line.lstrip().startswith("#") else line for line in read_text(path).splitlines())
    reader = csv.reader(lines, strict=True, skipinitialspace=True)
    rows: list[tuple[int, list[str]]] = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                rows.append((reader.line_num, cells))
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: cannot be read as a row of a table ({error}).") from error
    if not rows:
        return [], []
    (_, head), *rest = rows
    if len(head) == 1 and ";" in head[0]:
        raise InputError(f"{path}: columns are separated by semicolons; use commas (and decimal points in numbers).")
    for line, cells in rest:
        if len(cells) < len(head) or any(cells[len(head) :]):
            count = f"{len(cells)} cells, but the header has {len(head)}"
            raise InputError(f"{path}, line {line}: the row has {count}. It may be cut, or have decimal commas.")
    refuse_half_a_line(path)
    return [name.casefold() for name in head], [(line, cells[: len(head)]) for line, cells in rest]


def refuse_half_a_line(path: Path) -> None:
    """InputError if a file does not end with a line break, as every program ends it: half a number is another one."""
    with path.open("rb") as file:
        if not file.read().endswith((b"\n", b"\r")):
            raise InputError(f"{path}: {_CUT}")


def refuse_damaged_toml(path: Path | str, text: str, content: object, key: str = "") -> None:
    """InputError for damage that is valid TOML: a text that ends within a number, a null character in a string."""
    if re.search(r"\d\Z", text) and "#" not in text.splitlines()[-1]:
        raise InputError(f"{path}: {_CUT}")
    if isinstance(content, str) and "\0" in content:
        raise InputError(f"{path}: {key} has a null character (\\u0000), which no name has. Type it again.")
    if isinstance(content, dict):
        for name, value in content.items():
            refuse_damaged_toml(path, "", value, name)
    if isinstance(content, list):
        for value in content:
            refuse_damaged_toml(path, "", value, key)
