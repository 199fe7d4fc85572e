"""Options of models: the synthetic heel, the mesh, the plate, the simulation, and the comparison with a measurement."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple

from pydantic import AfterValidator, Field

from mrstrain.options.measurement import Frame, Unit
from mrstrain.options.model import Cli, Flag, Names, NotNegative, Options, Positive, Real, Vector

MINUTE_S = 60.0


def _limit(told: str) -> Cli:
    return Cli("--limit-minutes", told, "Advanced", times=MINUTE_S)


class Labelling(Options):
    """What a label map's labels are."""

    panel: ClassVar[str] = "Inputs"

    names: Path | None = None
    """Names of the labels: ITK-SNAP or Slicer table, or CSV."""
    bones: Annotated[Names, Field(min_length=1), Cli("--bone")] = ("bone",)
    """Label of bone. It is cut out of meshes and its surface fixed; slices go through the lowest point of the first."""


class LabelMapFile(Labelling):
    """A label map, and what its labels are."""

    labels: Path
    """Label map of the unloaded image."""


class Finer(NamedTuple):
    """Another length of edges in one tissue."""

    region: str
    edge_mm: Positive


class Meshing(Options):
    """How a label map is meshed."""

    panel: ClassVar[str] = "Model"

    edge_mm: Positive = 2.0
    """Length of edges wanted, mm; beyond four voxels these set it."""
    finer: Finer | None = None
    """Another edge length in one region, mm, such as skin 1."""
    limit_s: Annotated[Positive, _limit("Time after which meshing is given up.")] = 3600.0
    """Time after which meshing is given up, s."""


class MeshCoordinates(Options):
    """Unit and frame of a mesh made elsewhere."""

    panel: ClassVar[str] = "Inputs"

    mesh_unit: Unit = "mm"
    """Unit of the mesh's coordinates."""
    mesh_frame: Frame = "LPS"
    """Frame of the mesh's coordinates."""


class Directions(Options):
    """Where the plate lies, and where it shears."""

    panel: ClassVar[str] = "Model"

    plate_normal: Vector = (0.0, 0.0, -1.0)
    """The plate's outward normal, away from the foot, LPS. Default: 0 0 -1 (patient inferior)."""
    shear_direction: Vector = (0.0, -1.0, 0.0)
    """Direction of the shear force on the tissue, LPS, such as 0 -1 0 (anterior)."""


class HeelShape(Options):
    """Shape of a synthetic heel; ranges as in `phantoms.Heel`."""

    size: Real = 1.0
    """Factor on all shapes; 1 is a calcaneus 67 mm long."""
    pad_mm: Annotated[Real, Cli("--pad")] = 18.0
    """Tissue below the calcaneus, skin included, mm."""
    skin_mm: Annotated[Real, Cli("--skin")] = 2.0
    """Thickness of the skin, mm."""
    lobule_mm: Annotated[Real, Cli("--lobules")] = 6.0
    """Width of the fat's lobules, mm."""


class PlateOptions(Directions):
    """The rigid plate that presses and shears."""

    taped: Annotated[Flag, Cli("--slide", "No tape: skin slides along the plate without friction.", off=True)] = True
    """Skin that has touched the plate holds to it; if not, it slides without friction."""
    gap_mm: NotNegative = 0.0
    """Distance of the plate from the skin at the start, mm."""
    turns: Flag = False
    """The plate turns freely about its pivot."""
    pivot_mm: Annotated[Vector | None, Cli("--pivot")] = None
    """Point over which the plate's pivot lies, LPS mm. Default: where it touches first."""


class MaterialSets(Options):
    """Which material sets are simulated."""

    panel: ClassVar[str] = "Model"

    sets: Annotated[Names, Cli("--set")] = ("trebbi",)
    """akrami, erdemir, friedman, luboz, spears, trebbi, zwam, or a .toml of your own. Default: trebbi."""


class Followed(Options):
    """What is followed over meshes of several sizes."""

    panel: ClassVar[str] = "Model"

    region: str = "fat"
    """Region whose maximum shear strain is followed."""
    material: Annotated[str, Cli("--set")] = "trebbi"
    """Material set."""


class SimulationOptions(MaterialSets):
    """Which material sets are simulated, and how."""

    fixed: Annotated[Names, Cli("--fix")] = ()
    """Facets that do not move, beside the bone's, such as cut."""
    element: Literal["P1", "MINI", "P2"] = "P1"
    """P1 (fast), MINI, or P2 (quadratic: more exact, slow)."""
    decks: Annotated[Flag, Cli(panel="Output")] = False
    """Also write each load for CalculiX and FEBio."""
    limit_s: Annotated[
        Positive | None, _limit("Time after which a path of loads ends where it stands. Default: none.")
    ] = None
    """Time after which a set's path of loads ends at its last equilibrium, s; with more it goes on from there."""


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
    """Range of maximum shear strain of the areas."""
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
