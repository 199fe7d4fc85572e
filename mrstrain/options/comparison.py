"""Options of comparing: how a model's results are read, and what is compared."""

from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import AfterValidator

from mrstrain.options.measurement import Frame, Unit
from mrstrain.options.model import Cli, Flag, NotNegative, Options, Real


class ModelReading(Options):
    """How the files of models are read; a ``model.toml`` beside a model's files has its own."""

    panel: ClassVar[str] = "Model"

    model_mesh: Path | None = None
    """Mesh of nodal displacements in .csv files."""
    model_unit: Unit = "mm"
    """Unit of the mesh's coordinates."""
    model_frame: Frame = "LPS"
    """Frame of the mesh's coordinates."""


def _rising(strains: tuple[float, float]) -> tuple[float, float]:
    from validate import check_range

    check_range(strains)
    return strains


class ComparisonOptions(Options):
    """What of models and measurement is compared."""

    panel: ClassVar[str] = "Comparison"

    strains: Annotated[tuple[Real, Real], AfterValidator(_rising)] = (0.2, 0.5)
    """Range of maximal shear of the areas."""
    thresholds: Path | None = None
    """CSV: max_shear, source. Levels for clusters."""
    least_ml: NotNegative = 0.1
    """Volume of the smallest cluster that counts, mL."""


class ComparisonOn(ComparisonOptions):
    """What is compared, and where it is put."""

    mesh: Path | None = None
    """Where to compare. Default: the first model's mesh."""
    on_image: Annotated[Flag, Cli(panel="Output")] = False
    """Also each model's displacement and strain on the image's voxels."""
