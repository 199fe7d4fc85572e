"""Files of a label map that is made: where they are, what must not be overwritten, and what is told of them."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Self

import numpy as np

from dvc import LabelMap, TissueLabels, read_labels
from dvc.arrays import FloatArray
from dvc.errors import InputError, OutputError, few
from dvc.images.bone_names import is_bones_name
from dvc.io.images.read import read_header
from dvc.io.result_folder import same_grid
from dvc.own_files import read_json
from dvc.report.drawing import ENDINGS
from dvc.report.page import Section
from dvc.report.sheet import View
from mrstrain.records.inputs import WRITTEN, alone, image_stem, made_from_image, output_folder
from mrstrain.records.outcome import Outcome


@dataclass(frozen=True, slots=True)
class Labelled(Outcome):
    """The label map that was made: what is told of it in a line, and its section of a report."""

    headline: str = field(kw_only=True)
    section: Section = field(kw_only=True)


@dataclass(frozen=True, slots=True)
class LabelFiles:
    """A label map, and the files beside it."""

    labels: Path
    ending: str

    @classmethod
    def of(cls, out: Path | str, inputs: Sequence[Path]) -> Self:
        """The files of an output; InputError for an unknown format, OutputError if an input would be overwritten."""
        target = Path(out)
        ending = next((one for one in WRITTEN if target.name.lower().endswith(one)), None)
        if ending is None:
            raise InputError(f"The output (out) is the label map and must end in {', '.join(WRITTEN)}; got {target}.")
        files = cls(target, ending)
        written = [target, files.probability, *map(files.beside, (".csv", ".json", "_probability.json", *ENDINGS))]
        for path in inputs:
            if path.resolve() in [one.resolve() for one in written]:
                raise OutputError(f"{path} is an input and would be overwritten. Choose another output file (out).")
        return files

    def beside(self, ending: str) -> Path:
        """A file with the name of the label map and another ending."""
        return self.stem.with_name(self.stem.name + ending)

    @property
    def stem(self) -> Path:
        """The label map without its ending."""
        return self.labels.with_name(image_stem(self.labels.name))

    @property
    def probability(self) -> Path:
        """Probability of each tissue."""
        return self.beside(f"_probability{self.ending}")

    def remove_probability(self) -> None:
        """Remove the probability of each tissue, which a label map that was drawn does not have."""
        for path in (self.probability, self.beside("_probability.json")):
            path.unlink(missing_ok=True)

    @property
    def picture(self) -> Path:
        """The picture to look at first."""
        return self.beside(ENDINGS[0])

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Make the folder; OutputError where another run writes the same label map."""
        with output_folder(self.labels.parent), alone(self.labels, self.labels.with_name(f".{self.labels.name}.lock")):
            yield


def read_made(labels: Path, names: Path | None) -> TissueLabels | None:
    """A label map that `label` made from an image, with its probabilities; None for any other, or one changed since.

    InputError if the file with the probabilities, which lies beside it, cannot be read.
    """
    made = made_from_image(labels)
    if made is None:
        return None
    files, given = LabelFiles.of(labels, ()), read_labels(labels, names)
    try:
        tissues = [str(name) for name in read_json(files.beside("_probability.json"))["components"]]
        stored = read_header(files.probability, vectors=True, components=len(tissues))
        same_grid(files.probability, stored.grid, given.grid)
        probability = np.moveaxis(stored.load(), -1, 0)
    except (OSError, ValueError, LookupError, TypeError) as lacking:
        raise InputError(
            f"{files.probability}: the probabilities that belong to {labels.name} cannot be read. Put them beside it, "
            "or make the label map again (mrstrain label)."
        ) from lacking
    numbers = {name: number for number, name in given.names.items()}
    if not set(numbers) <= set(tissues):
        named = f"has the tissues {few(tissues)}, not {few(numbers)}"
        raise InputError(f"{labels}: it {named}. Give the table of names written with it as names (--names).")
    unused = count(max(given.names) + 1)  # for tissues without a voxel
    listed = {numbers[name] if name in numbers else next(unused): name for name in tissues}
    return TissueLabels(replace(given, names=listed), probability, made.notes)


def volumes_ml(labels: LabelMap) -> Mapping[str, float]:
    """Volume of each tissue, mL."""
    voxel_ml = labels.grid.voxel_volume_mm3 / 1000.0
    return {name: float(np.count_nonzero(labels.labels == n) * voxel_ml) for n, name in labels.names.items()}


def view_of(labels: LabelMap) -> View:
    """Slices through the lowest point of the first bone, or of the body if there is none."""
    return View.through(labels.grid, _lowest(labels), labels.labels > 0)


def _lowest(labels: LabelMap) -> FloatArray:
    bones = [number for number, name in labels.names.items() if is_bones_name(name)]
    inside = np.isin(labels.labels, bones[:1])
    points = labels.grid.points(inside if inside.any() else labels.labels > 0)
    return np.asarray(points[np.argmin(points[:, 2])])
