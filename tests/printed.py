"""A page as a browser prints it: on which sheets of the PDF its headings, pictures and captions lie."""

from __future__ import annotations

import base64
import re

from tests.browser import Tab

PAPERS = {"A4": (8.27, 11.69), "Letter": (8.5, 11.0)}
"""Width and height, inches."""
_SHEET, _REFERENCE = re.compile(r"^(\d+) 0 obj\n<</Type /Page\n", re.MULTILINE), r"(\d+) 0 R"
_ELEMENT = re.compile(r"^(\d+) 0 obj\n<</Type /StructElem\n(.*?)\n/K (.*?)>>\nendobj", re.DOTALL | re.MULTILINE)


def printed(tab: Tab, paper: str = "A4") -> bytes:
    """The page that is open as a PDF in which headings, pictures and captions are tagged."""
    width, height = PAPERS[paper]
    how = {"paperWidth": width, "paperHeight": height, "printBackground": False, "generateTaggedPDF": True}
    return base64.b64decode(tab.call("Page.printToPDF", **how)["data"])


def sheets_of(pdf: bytes, kind: str) -> list[set[int]]:
    """The sheets, from 1, on which each element of a kind lies with all that it holds.

    The kinds are those of tagged PDF, such as ``H2``; a ``Figure`` is a ``figure`` of the page with its heading and
    caption, and the picture in it is another.
    """
    text = pdf.decode("latin-1")
    place = {int(number): at for at, number in enumerate(_SHEET.findall(text), 1)}
    elements = {int(number): (of, kids) for number, of, kids in _ELEMENT.findall(text)}

    def on(number: int) -> set[int]:
        of, kids = elements[number]
        own = {place[int(sheet)] for sheet in re.findall(f"/Pg {_REFERENCE}", of + kids)}
        return own.union(*(on(int(kid)) for kid in re.findall(_REFERENCE, kids) if int(kid) in elements))

    return [on(number) for number, (of, _) in elements.items() if of.startswith(f"/S /{kind}\n")]
