"""The commands of the finite-element side. They parse, call one function, and print."""

from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.options import Out, Workers, carry_out, takes_options, tell
from mrstrain.options import modelling
from mrstrain.options.measurement import Cores, RecordedEngine, RecordedFiles, Seeded

LabelMap = Annotated[Path, typer.Argument(help="Label map of the tissues on the unloaded image.")]
Measured = Annotated[
    Path,
    typer.Argument(metavar="results", help="Results folder of register, or the folder of one of its loads."),
]
Loads = Annotated[
    list[str] | None,
    typer.Option(
        help="NAME=NORMAL or NAME=NORMAL,SHEAR: forces in N (Load3=15,45), or plate displacements with the unit mm "
        "(Load3=15,8mm). Default: the published loads Load1=140, Load2=15, Load3=15,45 and Load4=15,12. Repeat for "
        "several.",
        rich_help_panel="Model",
    ),
]


@takes_options
def mesh(
    labels: LabelMap,
    out: Annotated[
        Path,
        typer.Option(
            help="File name of the mesh, ending in .vtu; a .json, a .png, a .pdf and a .log of the same name are also "
            "written.",
            rich_help_panel="Output",
        ),
    ],
    labelling: modelling.Labelling,
    meshing: modelling.Meshing,
) -> None:
    """Mesh the soft tissues of a label map with tetrahedra, with named tissues and surface sets.

    The surface sets are bone, skin, and cut (the truncation surface).
    """
    carry_out(mrstrain.mesh.with_options, labels, out=out, labelling=labelling, meshing=meshing)


@takes_options
def simulate(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra with surface sets 'bone' and 'skin'.")], out: Out,
    simulation: modelling.SimulationOptions, plate_options: modelling.PlateOptions,
    coordinates: modelling.MeshCoordinates, cores: Cores, load: Loads = None,
) -> None:  # fmt: skip
    """Simulate the compression and shear of soft tissue between fixed bone and a rigid plate.

    Results are displacement, strain and stress.
    """
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
        typer.Argument(help="One folder per model, with one file per load (Load1.vtu, .frd, .csv ...)."),
    ],
    out: Out, labelling: modelling.ComparisonLabels, reading: modelling.ModelReading,
    directions: modelling.ComparisonDirections, comparison: modelling.ComparisonOn,
    to_image: Annotated[
        Path | None,
        typer.Option(
            help="Text file with the 4 x 4 matrix from the frame of the models to that of the image, LPS mm.",
            rich_help_panel="Model",
        ),
    ] = None,
    variants: Annotated[
        list[Path] | None,
        typer.Option(
            help="Results of a model with one input changed (a folder with a variant.toml), or a folder of such "
            "folders; used to compute the input uncertainty. Repeat for several.",
            rich_help_panel="Model",
        ),
    ] = None,
) -> None:  # fmt: skip
    """Compare FE models of any code with a measurement: strain-volume curves, area metric, location, agreement."""
    from mrstrain.records.inputs import read_matrix

    matrix = None if to_image is None else read_matrix(to_image)
    carry_out(
        mrstrain.compare.with_options, dvc, models, out=out, labelling=labelling, reading=reading, to_image=matrix,
        directions=directions, comparison=comparison, variants=variants or (),
    )  # fmt: skip


@takes_options
def drive(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra; its surface set 'bone' is fixed.")], dvc: Measured,
    out: Out, material: modelling.MaterialSets, coordinates: modelling.MeshCoordinates,
) -> None:  # fmt: skip
    """Simulate with measured boundary conditions, to compare material sets independently of the plate contact."""
    carry_out(mrstrain.drive.with_options, mesh, dvc, out=out, material=material, coordinates=coordinates)


@takes_options
def level(
    dvc: Annotated[
        Path,
        typer.Argument(
            metavar="results",
            help="Results folder of register, whose record supplies the options that you leave out; or the unloaded "
            "image alone.",
        ),
    ],
    model: Annotated[Path, typer.Argument(help="Folder of a model with one file per load, as in compare.")],
    out: Out, subject_files: RecordedFiles, engine: RecordedEngine, reading: modelling.ModelReading, seeded: Seeded,
    load: Annotated[
        list[str] | None,
        typer.Option(
            help="Name of a load. Default: all loads of the model. Repeat for several.", rich_help_panel="Model"
        ),
    ] = None,
) -> None:  # fmt: skip
    """Forward-model comparison: warp the image by a model's displacement, and register it like the real pair."""
    carry_out(
        mrstrain.level.with_options, dvc, model, out=out, subject_files=subject_files, loads=load or (),
        engine=engine, reading=reading, seeded=seeded,
    )  # fmt: skip


@takes_options
def converge(
    labels: LabelMap, out: Out,
    edge_mm: Annotated[
        list[float],
        typer.Option(
            help="Edge length, mm. Give at least three: --edge-mm 4 --edge-mm 2.6 --edge-mm 1.9.",
            rich_help_panel="Model",
        ),
    ],
    labelling: modelling.Labelling, directions: modelling.Directions, followed: modelling.Followed, load: Loads = None,
    workers: Workers = None,
) -> None:  # fmt: skip
    """Mesh convergence: simulate the same loads at several edge lengths, and extrapolate to an infinitely fine mesh."""
    from mrstrain.models.simulate import loads_named

    carry_out(
        mrstrain.converge.with_options, labels, edge_mm, out=out, labelling=labelling, followed=followed,
        loads=loads_named(load), directions=directions, workers=workers,
    )  # fmt: skip


def fit(
    curve: Annotated[
        Path,
        typer.Argument(
            help="CSV with the columns stretch and nominal_stress_kpa (or _mpa, or true_stress_...); optional: test."
        ),
    ],
    out: Out,
    law: Annotated[
        str,
        typer.Option(help="Constitutive model: neo-Hooke, Isihara, Yeoh, Ogden, Ogden-2, Ogden-3 or Hencky."),
    ],
    test: Annotated[
        str | None,
        typer.Option(help="Kind of test: uniaxial, equibiaxial or 'pure shear'. Default: the column test of the file."),
    ] = None,
    nu: Annotated[float, typer.Option(help="Poisson's ratio for simulations.")] = 0.4999,
    tissue: Annotated[str, typer.Option(help="Tissue to which the written material set assigns the model.")] = "fat",
) -> None:
    """Fit a constitutive model to a stress-stretch curve, with 95 % intervals and the range of stability."""
    tell(mrstrain.fit(curve, law, out=out, test=test, nu=nu, tissue=tissue))
