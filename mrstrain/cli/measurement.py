"""The commands that measure: from images, or what another tool made of them, to strain."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mrstrain.cli.options import (
    Align,
    Bending,
    Bone,
    BoneLabel,
    Borders,
    EngineName,
    FieldFrame,
    Frame,
    Labels,
    MeshFile,
    MeshFrame,
    MeshUnit,
    Names,
    Out,
    Parameters,
    Plate,
    Preset,
    Shear,
    Start,
    StartFrame,
    Tissue,
    Unit,
    Volume,
)


def register(
    load0: Annotated[Path, typer.Argument(help="Unloaded image: NIfTI, NRRD, MHA, enhanced DICOM, or a DICOM folder.")],
    loads: Annotated[list[Path], typer.Argument(help="Loaded images.")],
    out: Out,
    bone: Bone = None,
    bone_label: BoneLabel = None,
    tissue: Tissue = None,
    labels: Labels = None,
    names: Names = None,
    align: Annotated[Align, typer.Option(help="What to align rigidly first.")] = Align.BONE,
    engine: EngineName = None,
    bending: Bending = None,
    volume: Volume = None,
    borders: Borders = None,
    preset: Preset = None,
    parameters: Parameters = None,
    allow_unknown_parameters: Annotated[
        bool, typer.Option("--allow-unknown-parameters", help="Accept parameter names we do not know.")
    ] = False,
    chain: Annotated[
        bool,
        typer.Option("--chain", help="Start each load from the result of the one before it, in the order given."),
    ] = False,
    start: Start = None,
    start_frame: StartFrame = None,
    repeat: Annotated[Path | None, typer.Option(help="A second unloaded image: gives the noise floor.")] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(help="CSV of landmark pairs (x0,y0,z0,x1,y1,z1 in mm LPS); for a single loaded image."),
    ] = None,
    mesh: MeshFile = None,
    mesh_unit: MeshUnit = Unit.MM,
    mesh_frame: MeshFrame = Frame.LPS,
    plate_normal: Plate = None,
    shear_direction: Shear = None,
    error_model: Annotated[
        Path | None, typer.Option(help="Error model that `mrstrain accuracy` wrote, instead of the preset's own.")
    ] = None,
    twin: Annotated[
        bool,
        typer.Option("--twin", help="Also register each pair's twin, whose strain is known: judges error bars."),
    ] = False,
    allow_missing: Annotated[
        bool,
        typer.Option("--allow-missing", help="Leave NaN or infinite voxels out instead of refusing the image."),
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Loads registered at once. Default: as many as cores and loads allow."),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(min=1, help="Threads of each worker. Results are equal bit for bit on equal threads."),
    ] = None,
    seed: Annotated[int, typer.Option(min=1, help="Seed of all random numbers.")] = 1,
) -> None:
    """Displacement and strain of loaded images against the unloaded one, with quality and a report."""
    from mrstrain.measurement.register import register as run
    from mrstrain.records.progress import live

    with live() as progress:
        results = run(
            load0,
            loads,
            out=out,
            bone=bone,
            bone_label=bone_label,
            tissue=tissue,
            labels=labels,
            names=names,
            align=align.value,
            engine=None if engine is None else engine.value,
            bending=bending,
            volume=volume,
            borders=borders,
            preset=preset,
            parameters=parameters or (),
            allow_unknown_parameters=allow_unknown_parameters,
            chain=chain,
            start=start,
            start_frame=None if start_frame is None else start_frame.value,
            repeat=repeat,
            landmarks=landmarks,
            mesh=mesh,
            mesh_unit=mesh_unit.value,
            mesh_frame=mesh_frame.value,
            plate_normal=plate_normal,
            shear_direction=shear_direction,
            error_model=error_model,
            twin=twin,
            allow_missing=allow_missing,
            workers=workers,
            threads=threads,
            seed=seed,
            progress=progress,
        )
    for line in results.summary():
        typer.echo(line)
    if results.failures:
        raise typer.Exit(1)


def strain(
    reference: Annotated[Path, typer.Argument(help="Unloaded image: gives the grid.")],
    deformation: Annotated[
        Path,
        typer.Argument(help="elastix transform .txt, ITK transform (.h5, .tfm), or a displacement image."),
    ],
    out: Out,
    bone: Bone = None,
    bone_label: BoneLabel = None,
    tissue: Tissue = None,
    labels: Labels = None,
    names: Names = None,
    frame: FieldFrame = None,
    mesh: MeshFile = None,
    mesh_unit: MeshUnit = Unit.MM,
    mesh_frame: MeshFrame = Frame.LPS,
    plate_normal: Plate = None,
    shear_direction: Shear = None,
) -> None:
    """Strain maps from a transform or displacement field that any tool has made."""
    from mrstrain.measurement.strain import strain as run

    results = run(
        reference,
        deformation,
        out=out,
        bone=bone,
        bone_label=bone_label,
        tissue=tissue,
        labels=labels,
        names=names,
        frame=None if frame is None else frame.value,
        mesh=mesh,
        mesh_unit=mesh_unit.value,
        mesh_frame=mesh_frame.value,
        plate_normal=plate_normal,
        shear_direction=shear_direction,
    )
    for line in results.summary():
        typer.echo(line)
