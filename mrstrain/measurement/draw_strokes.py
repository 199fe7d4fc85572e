"""`draw_strokes`: a page for drawing the strokes that `label` takes as marks."""

from dataclasses import dataclass
from pathlib import Path

from dvc import read_image
from dvc.arguments import checked
from dvc.errors import InputError
from dvc.io.images.write import refuse_overwriting_inputs
from dvc.report.strokes import STROKES, write_strokes_page
from mrstrain.records.inputs import output_folder
from mrstrain.records.outcome import Outcome


@dataclass(frozen=True, slots=True)
class StrokesPage(Outcome):
    """The page that was written."""


@checked
def draw_strokes(load0: Path | str, *, out: Path | str) -> StrokesPage:
    """Write a page for drawing strokes in the tissues of an unloaded image, in any browser and offline.

    Parameters
    ----------
    load0 : path
        Unloaded image; the page contains it.
    out : path
        The page, .html. It saves the strokes as strokes.nii.gz on the image's grid: ``marks`` of `label`.

    Raises
    ------
    InputError, OutputError
        If the image cannot be read, or the page is no .html file or cannot be written.
    """
    source, page = Path(load0), Path(out)
    if page.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"The page to draw on (--draw) must end in .html; got {page}.")
    refuse_overwriting_inputs([page], [source])
    image = read_image(source)
    with output_folder(page.parent):
        write_strokes_page(page, source.name, image)
    then = f"Open it in a browser, draw and save the strokes; then give them to label: --marks {STROKES}"
    return StrokesPage(page, (f"Page to draw strokes on: {page}", then))
