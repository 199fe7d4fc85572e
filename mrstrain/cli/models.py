"""The commands of the finite-element side. They parse, call one function, and print."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.options import Out, Workers, carry_out, takes_options, tell
from mrstrain.options import modelling
from mrstrain.options.measurement import Cores, EngineOptions, Seeded, SubjectFiles

LabelMap = Annotated[Path, typer.Argument(help="Label map of the tissues on the unloaded image.")]
Measured = Annotated[Path, typer.Argument(help="Results of register: a folder for each load, or one of these.")]
Loads = Annotated[
    list[str] | None,
    typer.Option(
        help="NAME=NORMAL or NAME=NORMAL,SHEAR in N, or with mm after a number plate displacement; repeat. "
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
    labelling: modelling.Labelling,
    meshing: modelling.Meshing,
) -> None:
    """Soft tissues of a label map as tetrahedra, with named tissues and surfaces (bone, skin, cut)."""
    from mrstrain.records.progress import live

    with live() as progress:
        watch = partial(progress, "mesh", "meshing")
        done = mrstrain.mesh.with_options(labels, out=out, labelling=labelling, meshing=meshing, watch=watch)
    tell(done)


@takes_options
def simulate(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra with facets 'bone' and 'skin'.")], out: Out,
    simulation: modelling.SimulationOptions, plate_options: modelling.PlateOptions,
    coordinates: modelling.MeshCoordinates, cores: Cores, load: Loads = None,
) -> None:  # fmt: skip
    """A rigid plate presses and shears soft tissue on fixed bone: displacement, strain and stress for each load."""
    from mrstrain.models.simulate import loads_named

    carry_out(
        mrstrain.simulate.with_options, mesh, out=out, simulation=simulation, loads=loads_named(load),
        plate_options=plate_options, coordinates=coordinates, cores=cores,
    )  # fmt: skip


@takes_options
def compare(
    dvc: Measured,
    models: Annotated[
        list[Path],
        typer.Argument(help="For each model a folder with a file for each load (Load1.vtu, .frd, .csv ...)."),
    ],
    out: Out, labelling: modelling.LabelMapFile, reading: modelling.ModelReading, directions: modelling.Directions,
    comparison: modelling.ComparisonOn,
    to_image: Annotated[
        Path | None,
        typer.Option(help="Text file: 4 x 4 map of the models' frame to the image's, LPS mm.", rich_help_panel="Model"),
    ] = None,
) -> None:  # fmt: skip
    """Finite-element models of any code against a measurement: curves, areas, location, agreement, and a report."""
    from mrstrain.records.inputs import read_matrix

    matrix = None if to_image is None else read_matrix(to_image)
    carry_out(
        mrstrain.compare.with_options, dvc, models, out=out, labelling=labelling, reading=reading, to_image=matrix,
        directions=directions, comparison=comparison,
    )  # fmt: skip


@takes_options
def drive(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra; facets 'bone' do not move.")], dvc: Measured,
    out: Out, material: modelling.MaterialSets, coordinates: modelling.MeshCoordinates,
) -> None:  # fmt: skip
    """A model whose outside goes where the measurement puts it: laws are judged apart from the plate."""
    carry_out(mrstrain.drive.with_options, mesh, dvc, out=out, material=material, coordinates=coordinates)


@takes_options
def level(
    load0: Annotated[Path, typer.Argument(help="The unloaded image.")],
    model: Annotated[Path, typer.Argument(help="Folder of a model, with a file for each load, as in compare.")],
    out: Out, subject_files: SubjectFiles, engine: EngineOptions, reading: modelling.ModelReading, seeded: Seeded,
    load: Annotated[
        list[str] | None,
        typer.Option(help="Name of a load; repeat. Default: all of the model's.", rich_help_panel="Model"),
    ] = None,
) -> None:  # fmt: skip
    """A model sent through the measurement itself (it moves the image, which is registered): like against like."""
    carry_out(
        mrstrain.level.with_options, load0, model, out=out, subject_files=subject_files, loads=load or (),
        engine=engine, reading=reading, seeded=seeded,
    )  # fmt: skip


@takes_options
def converge(
    labels: LabelMap, out: Out,
    edge_mm: Annotated[list[float], typer.Option(help="Length of edges, mm; three or more.", rich_help_panel="Model")],
    labelling: modelling.Labelling, directions: modelling.Directions, followed: modelling.Followed, load: Loads = None,
    workers: Workers = None,
) -> None:  # fmt: skip
    """The same loads on meshes of several sizes: percentiles of strain and plate travel, and what they tend to."""
    from mrstrain.models.simulate import loads_named

    carry_out(
        mrstrain.converge.with_options, labels, edge_mm, out=out, labelling=labelling, followed=followed,
        loads=loads_named(load), directions=directions, workers=workers,
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
    tissue: Annotated[str, typer.Option(help="Region that the law is for, in the set that is written.")] = "fat",
) -> None:
    """Parameters of a material law from a stretch-stress curve, with 95 % intervals and the range of stability."""
    tell(mrstrain.fit(curve, law, out=out, test=test, nu=nu, tissue=tissue))
