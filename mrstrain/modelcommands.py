"""The commands of the finite-element side. They parse, call one function, and print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mrstrain.options import Frame, MeshFrame, MeshUnit, Names, Out, Plate, Shear, Unit


def mesh(
    labels: Annotated[Path, typer.Argument(help="Label map of the tissues on the unloaded image.")],
    out: Annotated[Path, typer.Option(help="The mesh, ending in .vtu; a .json and a .png are written beside it.")],
    edge_mm: Annotated[float, typer.Option(help="Length of edges wanted, mm.")] = 2.0,
    names: Names = None,
    bone: Annotated[
        list[str] | None, typer.Option(help="Region to cut out, whose surface is fixed; repeat for several.")
    ] = None,
    finer: Annotated[
        tuple[str, float] | None, typer.Option(help="Another edge length in one region, such as --finer skin 1.")
    ] = None,
    limit_minutes: Annotated[float, typer.Option(help="Time after which meshing is given up.")] = 60.0,
) -> None:
    """Soft tissues of a label map as tetrahedra, with named tissues and surfaces (bone, skin, cut)."""
    from mrstrain.meshing import mesh as run
    from mrstrain.progress import live

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
        typer.Option("--set", help="Published material set, or a file of your own (.toml); repeat for several."),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(help="NAME=NORMAL or NAME=NORMAL,SHEAR in N; repeat. Default: the published experiment's four."),
    ] = None,
    plate_normal: Plate = None,
    shear_direction: Shear = None,
    slide: Annotated[
        bool, typer.Option("--slide", help="No tape: skin slides along the plate without friction.")
    ] = False,
    gap_mm: Annotated[float, typer.Option(min=0.0, help="Distance of the plate from the skin at the start, mm.")] = 0.0,
    fix: Annotated[list[str] | None, typer.Option(help="Facets that do not move; repeat. Default: bone.")] = None,
    element: Annotated[str, typer.Option(help="P1 (fast), MINI, or P2 (quadratic: more exact, slow).")] = "P1",
    decks: Annotated[bool, typer.Option("--decks", help="Also write each load for CalculiX and FEBio.")] = False,
    mesh_unit: MeshUnit = Unit.MM,
    mesh_frame: MeshFrame = Frame.LPS,
    workers: Annotated[int | None, typer.Option(min=1, help="Simulations at once. Default: one for each core.")] = None,
) -> None:
    """A rigid plate presses and shears soft tissue on fixed bone: displacement, strain and stress for each load."""
    from mrstrain.progress import live
    from mrstrain.simulating import LOADS, load_named
    from mrstrain.simulating import simulate as run

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
            fixed=fix or ("bone",),
            element=element,
            decks=decks,
            mesh_unit=mesh_unit.value,
            mesh_frame=mesh_frame.value,
            workers=workers,
            progress=progress,
        )
    for line in done.summary():
        typer.echo(line)
    if not done.complete:
        raise typer.Exit(1)


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
    from mrstrain.converging import converge as run
    from mrstrain.progress import live
    from mrstrain.simulating import LOADS, load_named

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
    from mrstrain.fitting import fit as run

    for line in run(curve, law, out=out, test=test, nu=nu, tissue=tissue).summary():
        typer.echo(line)
