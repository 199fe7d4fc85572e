"""The commands of the finite-element side. They parse, call one function, and print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mrstrain.cli.options import (
    Bone,
    BoneLabel,
    Borders,
    EngineName,
    Frame,
    Labels,
    MeshFrame,
    MeshUnit,
    ModelMesh,
    Names,
    Out,
    Parameters,
    Plate,
    Preset,
    Shear,
    Tissue,
    Unit,
)


def mesh(
    labels: Annotated[Path, typer.Argument(help="Label map of the tissues on the unloaded image.")],
    out: Annotated[Path, typer.Option(help="The mesh, ending in .vtu; a .json and a .png are written beside it.")],
    edge_mm: Annotated[float, typer.Option(help="Length of edges wanted, mm; beyond four voxels these set it.")] = 2.0,
    names: Names = None,
    bone: Annotated[
        list[str] | None, typer.Option(help="Bone to cut out, whose surface is fixed; repeat for all. Default: bone.")
    ] = None,
    finer: Annotated[
        tuple[str, float] | None, typer.Option(help="Another edge length in one region, such as --finer skin 1.")
    ] = None,
    limit_minutes: Annotated[float, typer.Option(help="Time after which meshing is given up.")] = 60.0,
) -> None:
    """Soft tissues of a label map as tetrahedra, with named tissues and surfaces (bone, skin, cut)."""
    from mrstrain.models.mesh import mesh as run
    from mrstrain.records.progress import live

    with live() as progress:
        made = run(
            labels,
            out=out,
            edge_mm=edge_mm,
            names=names,
            bones=bone or ("bone",),
            finer=finer,
            limit_s=60.0 * limit_minutes,
            watch=lambda share: progress("mesh", "meshing", share),
        )
    for line in made.summary():
        typer.echo(line)


def simulate(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra with facets 'bone' and 'skin'.")],
    out: Out,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="akrami, erdemir, friedman, luboz, spears, trebbi, zwam, or a .toml of your own; repeat. "
            "Default: trebbi.",
        ),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=NORMAL or NAME=NORMAL,SHEAR in N, or with mm after a number the plate's travel; repeat. "
            "Default: the published experiment's four."
        ),
    ] = None,
    plate_normal: Plate = None,
    shear_direction: Shear = None,
    slide: Annotated[
        bool, typer.Option("--slide", help="No tape: skin slides along the plate without friction.")
    ] = False,
    gap_mm: Annotated[float, typer.Option(min=0.0, help="Distance of the plate from the skin at the start, mm.")] = 0.0,
    turns: Annotated[bool, typer.Option("--turns", help="The plate turns freely about its pivot.")] = False,
    pivot: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="Point over which the plate's pivot lies, LPS mm. Default: where it touches first."),
    ] = None,
    fix: Annotated[
        list[str] | None, typer.Option(help="Facets that do not move, beside the bone's, such as cut; repeat.")
    ] = None,
    element: Annotated[str, typer.Option(help="P1 (fast), MINI, or P2 (quadratic: more exact, slow).")] = "P1",
    decks: Annotated[bool, typer.Option("--decks", help="Also write each load for CalculiX and FEBio.")] = False,
    limit_minutes: Annotated[
        float | None,
        typer.Option(help="Time after which a path of loads ends where it stands. Default: none."),
    ] = None,
    mesh_unit: MeshUnit = Unit.MM,
    mesh_frame: MeshFrame = Frame.LPS,
    workers: Annotated[int | None, typer.Option(min=1, help="Simulations at once. Default: one for each core.")] = None,
) -> None:
    """A rigid plate presses and shears soft tissue on fixed bone: displacement, strain and stress for each load."""
    from mrstrain.models.loads import LOADS, load_named
    from mrstrain.models.simulate import simulate as run
    from mrstrain.records.progress import live

    with live() as progress:
        done = run(
            mesh,
            out=out,
            sets=set_ or ("trebbi",),
            loads=[load_named(text) for text in load] if load else LOADS,
            plate_normal=plate_normal or (0.0, 0.0, -1.0),
            shear_direction=shear_direction or (0.0, -1.0, 0.0),
            taped=not slide,
            gap_mm=gap_mm,
            turns=turns,
            pivot_mm=pivot,
            fixed=fix or (),
            element=element,
            decks=decks,
            limit_s=None if limit_minutes is None else 60.0 * limit_minutes,
            mesh_unit=mesh_unit.value,
            mesh_frame=mesh_frame.value,
            workers=workers,
            progress=progress,
        )
    for line in done.summary():
        typer.echo(line)
    if not done.complete:
        raise typer.Exit(1)


def compare(
    dvc: Annotated[Path, typer.Argument(help="Results of register: a folder for each load, or one of these.")],
    models: Annotated[
        list[Path],
        typer.Argument(help="For each model a folder with a file for each load (Load1.vtu, .frd, .csv ...)."),
    ],
    labels: Annotated[Path, typer.Option(help="Label map of the unloaded image.")],
    out: Out,
    names: Names = None,
    bone: Annotated[
        list[str] | None,
        typer.Option(
            help="Label of bone; repeat. The slice goes through the lowest point of the first. Default: bone."
        ),
    ] = None,
    mesh: Annotated[Path | None, typer.Option(help="Where to compare. Default: the first model's mesh.")] = None,
    model_mesh: ModelMesh = None,
    model_unit: MeshUnit = Unit.MM,
    model_frame: MeshFrame = Frame.LPS,
    to_image: Annotated[
        Path | None, typer.Option(help="Text file: 4 x 4 map of the models' frame to the image's, LPS mm.")
    ] = None,
    plate_normal: Plate = None,
    shear_direction: Shear = None,
    strains: Annotated[tuple[float, float], typer.Option(help="Range of maximal shear of the areas.")] = (0.2, 0.5),
    thresholds: Annotated[Path | None, typer.Option(help="CSV: max_shear, source. Levels for clusters.")] = None,
    least_ml: Annotated[float, typer.Option(help="Volume of the smallest cluster that counts, mL.")] = 0.1,
    on_image: Annotated[
        bool, typer.Option("--on-image", help="Also each model's displacement and strain on the image's voxels.")
    ] = False,
) -> None:
    """Finite-element models of any code against a measurement: curves, areas, location, agreement, and a report."""
    from mrstrain.comparison.compare import compare as run
    from mrstrain.records.inputs import read_matrix
    from mrstrain.records.progress import live

    with live() as progress:
        done = run(
            dvc,
            models,
            labels=labels,
            out=out,
            names=names,
            bones=bone or ("bone",),
            mesh=mesh,
            model_mesh=model_mesh,
            model_unit=model_unit.value,
            model_frame=model_frame.value,
            to_image=None if to_image is None else read_matrix(to_image),
            plate_normal=plate_normal or (0.0, 0.0, -1.0),
            shear_direction=shear_direction or (0.0, -1.0, 0.0),
            strains=strains,
            thresholds=thresholds,
            least_ml=least_ml,
            on_image=on_image,
            progress=progress,
        )
    for line in done.summary():
        typer.echo(line)


def drive(
    mesh: Annotated[Path, typer.Argument(help="Mesh of tetrahedra; facets 'bone' do not move.")],
    dvc: Annotated[Path, typer.Argument(help="Results of register: a folder for each load, or one of these.")],
    out: Out,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Published material set, or a file of your own (.toml); repeat for several."),
    ] = None,
    mesh_unit: MeshUnit = Unit.MM,
    mesh_frame: MeshFrame = Frame.LPS,
) -> None:
    """A model whose outside goes where the measurement puts it: laws are judged apart from the plate."""
    from mrstrain.comparison.drive import drive as run
    from mrstrain.records.progress import live

    with live() as progress:
        done = run(
            mesh,
            dvc,
            out=out,
            sets=set_ or ("trebbi",),
            mesh_unit=mesh_unit.value,
            mesh_frame=mesh_frame.value,
            progress=progress,
        )
    for line in done.summary():
        typer.echo(line)
    if not done.complete:
        raise typer.Exit(1)


def level(
    load0: Annotated[Path, typer.Argument(help="The unloaded image.")],
    model: Annotated[Path, typer.Argument(help="Folder of a model, with a file for each load, as in compare.")],
    out: Out,
    bone: Bone = None,
    bone_label: BoneLabel = None,
    tissue: Tissue = None,
    labels: Labels = None,
    names: Names = None,
    load: Annotated[list[str] | None, typer.Option(help="Name of a load; repeat. Default: all of the model's.")] = None,
    engine: EngineName = None,
    borders: Borders = None,
    preset: Preset = None,
    parameters: Parameters = None,
    model_mesh: ModelMesh = None,
    model_unit: MeshUnit = Unit.MM,
    model_frame: MeshFrame = Frame.LPS,
    threads: Annotated[int | None, typer.Option(min=1, help="Of each registration. Default: all cores.")] = None,
    seed: Annotated[int, typer.Option(help="Of noise and registration.")] = 1,
) -> None:
    """A model sent through the measurement itself (it moves the image, which is registered): like against like."""
    from mrstrain.comparison.level import level as run
    from mrstrain.records.progress import live

    with live() as progress:
        done = run(
            load0,
            model,
            out=out,
            bone=bone,
            bone_label=bone_label,
            tissue=tissue,
            labels=labels,
            names=names,
            loads=load or (),
            engine=None if engine is None else engine.value,
            borders=borders,
            preset=preset,
            parameters=parameters or (),
            model_mesh=model_mesh,
            model_unit=model_unit.value,
            model_frame=model_frame.value,
            threads=threads,
            seed=seed,
            progress=progress,
        )
    for line in done.summary():
        typer.echo(line)


def converge(
    labels: Annotated[Path, typer.Argument(help="Label map of the tissues on the unloaded image.")],
    out: Out,
    edge_mm: Annotated[list[float], typer.Option(help="Length of edges, mm; three or more.")],
    names: Names = None,
    bone: Annotated[list[str] | None, typer.Option(help="Region to cut out; repeat for several.")] = None,
    region: Annotated[str, typer.Option(help="Region whose maximal shear is followed.")] = "fat",
    set_: Annotated[str, typer.Option("--set", help="Material set.")] = "trebbi",
    load: Annotated[list[str] | None, typer.Option(help="As in simulate.")] = None,
    plate_normal: Plate = None,
    shear_direction: Shear = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Simulations at once. Default: one for each core.")] = None,
) -> None:
    """The same loads on meshes of several sizes: percentiles of strain and plate travel, and what they tend to."""
    from mrstrain.models.converge import converge as run
    from mrstrain.models.loads import LOADS, load_named
    from mrstrain.records.progress import live

    with live() as progress:
        done = run(
            labels,
            edge_mm,
            out=out,
            names=names,
            bones=bone or ("bone",),
            region=region,
            material=set_,
            loads=[load_named(text) for text in load] if load else LOADS,
            plate_normal=plate_normal or (0.0, 0.0, -1.0),
            shear_direction=shear_direction or (0.0, -1.0, 0.0),
            workers=workers,
            progress=progress,
        )
    for line in done.summary():
        typer.echo(line)


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
    from mrstrain.models.fit import fit as run

    for line in run(curve, law, out=out, test=test, nu=nu, tissue=tissue).summary():
        typer.echo(line)
