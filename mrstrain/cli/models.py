"""The commands of the finite-element side. They parse, call one function, and print."""

from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.options import Out, carry_out, takes_options, tell
from mrstrain.options.comparison import ComparisonOn, ModelReading
from mrstrain.options.measurement import Cores, EngineOptions, Seeded, SubjectFiles
from mrstrain.options.modelling import (
    Directions,
    Followed,
    Labelling,
    LabelMapFile,
    MaterialSets,
    MeshCoordinates,
    Meshing,
    PlateOptions,
    SimulationOptions,
)

LabelMap = Annotated[Path, typer.Argument(help="Label map of the tissues on the unloaded image.")]
Measured = Annotated[Path, typer.Argument(help="Results of register: a folder for each load, or one of these.")]
Loads = Annotated[
    list[str] | None,
    typer.Option(
        help="NAME=NORMAL or NAME=NORMAL,SHEAR in N, or with mm after a number the plate's travel; repeat. "
        "Default: the published experiment's four.",
        rich_help_panel="Model",
    ),
]


@takes_options
def mesh(
    labels: LabelMap,
    out: Annotated[
        Path,
        typer.Option(help="The mesh, ending in .vtu; with a .json and a .png beside it.", rich_help_panel="Output"),
    ],
    labelling: Labelling,
    meshing: Meshing,
) -> None:
    """Soft tissues of a label map as tetrahedra, with named tissues and surfaces (bone, skin, cut)."""
    carry_out(
        lambda progress: mrstrain.mesh.with_options(
            labels, out=out, labelling=labelling, meshing=meshing,
            watch=lambda share: progress("mesh", "meshing", share),
        )
    )  # fmt: skip


@takes_options
def simulate(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra with facets 'bone' and 'skin'.")],
    out: Out,
    simulation: SimulationOptions,
    plate_options: PlateOptions,
    coordinates: MeshCoordinates,
    cores: Cores,
    load: Loads = None,
) -> None:
    """A rigid plate presses and shears soft tissue on fixed bone: displacement, strain and stress for each load."""
    from mrstrain.models.loads import loads_named

    carry_out(
        lambda progress: mrstrain.simulate.with_options(
            mesh, out=out, simulation=simulation, loads=loads_named(load), plate_options=plate_options,
            coordinates=coordinates, cores=cores, progress=progress,
        )
    )  # fmt: skip


@takes_options
def compare(
    dvc: Measured,
    models: Annotated[
        list[Path],
        typer.Argument(help="For each model a folder with a file for each load (Load1.vtu, .frd, .csv ...)."),
    ],
    out: Out,
    labelling: LabelMapFile,
    reading: ModelReading,
    directions: Directions,
    comparison: ComparisonOn,
    to_image: Annotated[
        Path | None,
        typer.Option(help="Text file: 4 x 4 map of the models' frame to the image's, LPS mm.", rich_help_panel="Model"),
    ] = None,
) -> None:
    """Finite-element models of any code against a measurement: curves, areas, location, agreement, and a report."""
    from mrstrain.records.inputs import read_matrix

    matrix = None if to_image is None else read_matrix(to_image)
    carry_out(
        lambda progress: mrstrain.compare.with_options(
            dvc, models, out=out, labelling=labelling, reading=reading, to_image=matrix, directions=directions,
            comparison=comparison, progress=progress,
        )
    )  # fmt: skip


@takes_options
def drive(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra; facets 'bone' do not move.")],
    dvc: Measured,
    out: Out,
    material: MaterialSets,
    coordinates: MeshCoordinates,
) -> None:
    """A model whose outside goes where the measurement puts it: laws are judged apart from the plate."""
    carry_out(
        lambda progress: mrstrain.drive.with_options(
            mesh, dvc, out=out, material=material, coordinates=coordinates, progress=progress
        )
    )


@takes_options
def level(
    load0: Annotated[Path, typer.Argument(help="The unloaded image.")],
    model: Annotated[Path, typer.Argument(help="Folder of a model, with a file for each load, as in compare.")],
    out: Out,
    subject_files: SubjectFiles,
    engine: EngineOptions,
    reading: ModelReading,
    seeded: Seeded,
    load: Annotated[
        list[str] | None,
        typer.Option(help="Name of a load; repeat. Default: all of the model's.", rich_help_panel="Model"),
    ] = None,
) -> None:
    """A model sent through the measurement itself (it moves the image, which is registered): like against like."""
    carry_out(
        lambda progress: mrstrain.level.with_options(
            load0, model, out=out, subject_files=subject_files, loads=load or (), engine=engine, reading=reading,
            seeded=seeded, progress=progress,
        )
    )  # fmt: skip


@takes_options
def converge(
    labels: LabelMap,
    out: Out,
    edge_mm: Annotated[list[float], typer.Option(help="Length of edges, mm; three or more.", rich_help_panel="Model")],
    labelling: Labelling,
    directions: Directions,
    followed: Followed,
    load: Loads = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Simulations at once. Default: one for each core.", rich_help_panel="Advanced"),
    ] = None,
) -> None:
    """The same loads on meshes of several sizes: percentiles of strain and plate travel, and what they tend to."""
    from mrstrain.models.loads import loads_named

    carry_out(
        lambda progress: mrstrain.converge.with_options(
            labels, edge_mm, out=out, labelling=labelling, followed=followed, loads=loads_named(load),
            directions=directions, workers=workers, progress=progress,
        )
    )  # fmt: skip


def fit(
    curve: Annotated[
        Path,
        typer.Argument(
            help="CSV with columns stretch and nominal_stress_kpa (or _mpa, or true_stress_...), perhaps test."
        ),
    ],
    out: Out,
    law: Annotated[str, typer.Option(help="neo-Hooke, Isihara, Yeoh, Ogden, Ogden-2, Ogden-3 or Hencky.")],
    test: Annotated[
        str | None, typer.Option(help="uniaxial, equibiaxial or 'pure shear', where the file has no column for it.")
    ] = None,
    nu: Annotated[float, typer.Option(help="Poisson's ratio to simulate with.")] = 0.4999,
    tissue: Annotated[
        str, typer.Option(help="Region that the law is for, in the material set that is written.")
    ] = "fat",
) -> None:
    """Parameters of a material law from a stretch-stress curve, with 95 % intervals and the range of stability."""
    tell(mrstrain.fit(curve, law, out=out, test=test, nu=nu, tissue=tissue))
