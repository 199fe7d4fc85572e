"""Options of models: the phantom heel, the mesh, the plate, the simulation, and the comparison with a measurement."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator

from mrstrain.options.measurement import Frame, Unit
from mrstrain.options.model import Cli, Flag, Names, NotNegative, Options, Positive, Real, Vector

MINUTE_S = 60.0


def _limit(told: str) -> Cli:
    return Cli("--limit-minutes", told, "Advanced", times=MINUTE_S)


class Labelling(Options):
    """What a label map's labels are."""

    panel: ClassVar[str] = "Inputs"

    names: Path | None = None
    """Table of the label names: ITK-SNAP, Slicer or CSV."""
    bones: Annotated[Names, Cli("--bone")] = ()
    """Name of a bone label. Bones are cut out of the mesh and their surfaces are fixed. Default: every label that is
    named like a bone, such as bone, calcaneus or talus."""


class ComparisonLabels(Options):
    """The label map by which tissues are compared, and what its labels are."""

    panel: ClassVar[str] = "Inputs"

    labels: Path | None = None
    """Label map of the unloaded image. Default: that of the measurement, with its names and bone."""
    names: Path | None = None
    """Table of the label names: ITK-SNAP, Slicer or CSV. Default: that of the measurement, unless --labels is given."""
    bones: Annotated[Names, Cli("--bone")] = ()
    """Name of a bone label, which is not compared; slices in figures go through the first bone, where it is nearest to
    the plate. Default: the bone label of the measurement, if it had one and --labels is not given; otherwise every
    label that is named like a bone, such as bone, calcaneus or talus."""


class Finer(NamedTuple):
    """Edge length in one tissue."""

    region: str
    edge_mm: Positive


class Meshing(Options):
    """How a label map is meshed."""

    panel: ClassVar[str] = "Model"

    edge_mm: Positive = 2.0
    """Edge length of the cells, mm. Above about four voxels of the label map, the mesh hardly gets coarser; for fewer
    cells, use a coarser label map."""
    finer: Finer | None = None
    """Tissue with its own edge length, mm, such as: skin 1."""
    limit_s: Annotated[Positive, _limit("Stop meshing after this time, minutes.")] = 3600.0
    """Stop meshing after this time, s."""


class MeshCoordinates(Options):
    """Unit and frame of a mesh made elsewhere."""

    panel: ClassVar[str] = "Inputs"

    mesh_unit: Unit = "mm"
    """Unit of the mesh coordinates."""
    mesh_frame: Frame = "LPS"
    """Frame of the mesh coordinates."""


INFERIOR = (0.0, 0.0, -1.0)
"""Direction from the body to the plate that is assumed, LPS."""


class Directions(Options):
    """Where the plate lies, and where it shears."""

    panel: ClassVar[str] = "Model"

    plate_normal: Vector = INFERIOR
    """Direction from the body to the plate, in LPS (x left, y posterior, z superior). Default: 0 0 -1 (inferior)."""
    shear_direction: Vector = (0.0, -1.0, 0.0)
    """Direction of the shear force on the tissue, LPS. Default: 0 -1 0 (anterior)."""

    @property
    def is_placed(self) -> bool:
        """Whether somebody said where the plate lies."""
        return "plate_normal" in self.model_fields_set

    def assumed(self, instead: str) -> str:
        """A sentence if nobody said where the plate lies, with what to give ``instead``; empty otherwise."""
        if self.is_placed:
            return ""
        return f"The plate is taken to be inferior to the body (normal 0 0 -1, LPS). If it lies elsewhere, {instead}."


class ComparisonDirections(Options):
    """Where the plate lay, and where it sheared, in the measurement."""

    panel: ClassVar[str] = "Model"

    plate_normal: Vector | None = None
    """Direction from the body to the plate, in LPS (x left, y posterior, z superior). Default: that of the measurement,
    or 0 0 -1 (inferior)."""
    shear_direction: Vector | None = None
    """Direction of the shear force on the tissue, LPS. Default: that of the measurement, or 0 -1 0 (anterior)."""


class HeelShape(Options):
    """Shape of a phantom heel; ranges as in `phantoms.Heel`."""

    size: Real = 1.0
    """Scale factor of all shapes; 1 is a calcaneus 67 mm long."""
    pad_mm: Annotated[Real, Cli("--pad")] = 18.0
    """Thickness of the tissue below the calcaneus, including the skin, mm."""
    skin_mm: Annotated[Real, Cli("--skin")] = 2.0
    """Thickness of the skin, mm."""
    lobule_mm: Annotated[Real, Cli("--lobules")] = 6.0
    """Width of the fat lobules, mm."""


class PlateOptions(Directions):
    """The rigid plate that presses and shears."""

    taped: Annotated[
        Flag, Cli("--slide", "Let the skin slide along the plate without friction (no tape).", off=True)
    ] = True
    """Skin that has touched the plate sticks to it; otherwise it slides without friction."""
    gap_mm: NotNegative = 0.0
    """Distance between plate and skin at the start, mm."""
    turns: Flag = False
    """Let the plate rotate freely about its pivot."""
    pivot_mm: Annotated[Vector | None, Cli("--pivot")] = None
    """Point whose projection onto the plate is the pivot, LPS mm. Default: the first point of contact."""


class MaterialSets(Options):
    """Which material sets are simulated."""

    panel: ClassVar[str] = "Model"

    sets: Annotated[Names, Cli("--set")] = ("trebbi",)
    """Material set: akrami, erdemir, friedman, luboz, spears, trebbi, zwam, or your own .toml. Default: trebbi."""


class Followed(Options):
    """What is followed over meshes of several sizes."""

    panel: ClassVar[str] = "Model"

    region: str = "fat"
    """Tissue whose maximum shear strain is compared between meshes and extrapolated."""
    material: Annotated[str, Cli("--set")] = "trebbi"
    """Material set used on all meshes."""


class SimulationOptions(MaterialSets):
    """Which material sets are simulated, and how."""

    fixed: Annotated[Names, Cli("--fix")] = ()
    """Surface set that is fixed in addition to the bone, such as cut (the truncation surface)."""
    element: Literal["P1", "MINI", "P2"] = "P1"
    """Element: P1 (stabilised linear, fast), MINI (linear with bubble), or P2 (quadratic: more accurate, slow)."""
    decks: Annotated[Flag, Cli(panel="Output")] = False
    """Also write input files of each load for CalculiX and FEBio."""
    limit_s: Annotated[
        Positive | None,
        _limit("End a load path after this time, minutes, at its last converged increment. Default: no limit."),
    ] = None
    """End the load path of a material set after this time, s, at its last converged increment. A later run with a
    longer time continues from there."""


class ModelReading(Options):
    """How the files of models are read; a ``model.toml`` beside a model's files has its own."""

    panel: ClassVar[str] = "Model"

    model_mesh: Path | None = None
    """Mesh of the models, if their results are nodal displacements in .csv files."""
    model_unit: Unit = "mm"
    """Unit of the model coordinates."""
    model_frame: Frame = "LPS"
    """Frame of the model coordinates."""
    leave_out: Names = ()
    """Name of a region of the models that is not tissue, such as a plate. Rigid regions are always left out."""
    unfinished: Flag = False
    """Also compare results of FEBio and CalculiX whose run ended early."""


def _rising(strains: tuple[float, float]) -> tuple[float, float]:
    from validate import check_range

    check_range(strains)
    return strains


class ComparisonOptions(Options):
    """What of models and measurement is compared."""

    panel: ClassVar[str] = "Comparison"

    strains: Annotated[tuple[Real, Real], AfterValidator(_rising)] = (0.2, 0.5)
    """Range of maximum shear strain over which the area metric is computed. Default: 0.2 0.5."""
    thresholds: Path | None = None
    """CSV with the strain thresholds above which location is compared: columns max_shear, source. Default: 0.2, 0.3 and
    0.5."""
    least_ml: NotNegative = 0.1
    """Smallest volume of a cluster that counts, mL."""


class ComparisonOn(ComparisonOptions):
    """What is compared, and where it is put."""

    mesh: Path | None = None
    """Mesh on which the comparison is made. Default: the mesh of the first model."""
    on_image: Annotated[Flag, Cli(panel="Output")] = False
    """Also write the displacement and strain of each model on the voxels of the image."""
