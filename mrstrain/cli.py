"""The command line. It parses, calls one function, and prints; heavy imports wait until a command runs."""

from __future__ import annotations

import logging
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from mrstrain import modelcommands, studycommands
from mrstrain.options import (
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

app = typer.Typer(
    name="mrstrain",
    help="Strain inside soft tissue from pairs of MR images, and how far it may be trusted.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(asked: bool) -> None:
    if asked:
        from mrstrain import __version__

        typer.echo(f"mrstrain {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


for _study_command in (
    studycommands.init,
    studycommands.check,
    studycommands.run,
    studycommands.cohort,
    studycommands.demo,
):
    app.command()(_study_command)


@app.command()
def register(
    load0: Annotated[Path, typer.Argument(help="Unloaded image: NIfTI, NRRD, MHA, or a DICOM folder.")],
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
    from mrstrain.progress import live
    from mrstrain.registering import register as run

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


@app.command()
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
    from mrstrain.straining import strain as run

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


@app.command()
def phantom(
    out: Out,
    seed: Annotated[int, typer.Option(min=0, help="Of shapes, textures, noise and the foot's motions.")] = 1,
    load: Annotated[
        list[str] | None, typer.Option(help="Load1, Load2, Load3 or Load4; repeat for several. Default: all.")
    ] = None,
    spacing: Annotated[float, typer.Option(help="Edge of the voxels, mm.")] = 0.8,
    slice_spacing: Annotated[
        float | None, typer.Option(help="Their edge along the third axis, where it is another, mm.")
    ] = None,
    snr: Annotated[float, typer.Option(help="Fat's signal over the noise's standard deviation.")] = 25.0,
    no_noise: Annotated[bool, typer.Option("--no-noise", help="Images without noise.")] = False,
    size: Annotated[float, typer.Option(help="Factor on all shapes; 1 is a calcaneus 67 mm long.")] = 1.0,
    pad: Annotated[float, typer.Option(help="Tissue below the calcaneus, skin included, mm.")] = 18.0,
    skin: Annotated[float, typer.Option(help="Thickness of the skin, mm.")] = 2.0,
    lobules: Annotated[float, typer.Option(help="Width of the fat's lobules, mm.")] = 6.0,
) -> None:
    """Images of a synthetic heel under Load0 to Load4, with their exactly known strain."""
    from mrstrain.making import phantom as run
    from mrstrain.progress import live
    from phantoms.heel import LOADS

    with live() as progress:
        made = run(
            out,
            seed=seed,
            loads=load or tuple(LOADS),
            spacing_mm=(spacing, spacing, spacing if slice_spacing is None else slice_spacing),
            snr=None if no_noise else snr,
            size=size,
            pad_mm=pad,
            skin_mm=skin,
            lobule_mm=lobules,
            progress=progress,
        )
    for line in made.summary():
        typer.echo(line)


@app.command()
def twin(
    load0: Annotated[Path, typer.Argument(help="Unloaded image of your own.")],
    deformation: Annotated[
        Path,
        typer.Argument(help="The whole motion: elastix .txt, ITK transform (.h5, .tfm), or a displacement image."),
    ],
    out: Out,
    bone: Bone = None,
    bone_label: BoneLabel = None,
    tissue: Tissue = None,
    labels: Labels = None,
    names: Names = None,
    frame: FieldFrame = None,
    seed: Annotated[int, typer.Option(min=0, help="Of noise and shading.")] = 1,
) -> None:
    """A loaded image made of your own unloaded one, with the truth beside it: to see how well that is found."""
    from mrstrain.twinning import twin as run

    made = run(
        load0,
        deformation,
        out=out,
        bone=bone,
        bone_label=bone_label,
        tissue=tissue,
        labels=labels,
        names=names,
        frame=None if frame is None else frame.value,
        seed=seed,
    )
    for line in made.summary():
        typer.echo(line)


@app.command()
def accuracy(
    out: Out,
    preset: Annotated[
        list[str] | None,
        typer.Option(help="gauss-newton, gauss-newton-borders (labels), elastix' preset or file (.txt); repeatable."),
    ] = None,
    spacing: Annotated[list[float] | None, typer.Option(help="Edge of the voxels, mm; repeat for several.")] = None,
    slice_spacing: Annotated[
        float | None, typer.Option(help="Their edge along the third axis, where it is another, mm.")
    ] = None,
    snr: Annotated[list[float] | None, typer.Option(help="Signal-to-noise ratio; repeat for several.")] = None,
    motion: Annotated[
        list[str] | None,
        typer.Option(help="still, smooth, sliding, swelling, Load1 to Load4, wave-L (L mm); repeat for several."),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Heel; repeat for several. Default: 1 and 2. 9000 to 9999 are for published figures."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Registrations at once. Default: one for each core.")
    ] = None,
) -> None:
    """Error of a preset or engine on phantoms: by tissue, place, strain, noise, resolution. Goes on where it stopped.

    Without options 110 registrations: gauss-newton, seven motions and eight waves, voxels of 0.8 mm at SNR 25, 12 and
    50, of 1.2 mm and of 0.8 x 0.8 x 1.6 mm at SNR 25. With --spacing or --snr these alone (default 0.8 mm, 25).
    """
    from dvc.registration import GAUSS_NEWTON
    from mrstrain.progress import live
    from mrstrain.studying import CONDITIONS, MOTIONS, SEEDS, WAVES, cases_of
    from mrstrain.studying import accuracy as run

    conditions = CONDITIONS
    if spacing or snr or slice_spacing:
        conditions = tuple(((s, s, slice_spacing or s), r) for s in spacing or [0.8] for r in snr or [25.0])
    cases = cases_of(preset or (GAUSS_NEWTON,), conditions, motion or (*MOTIONS, *WAVES), seed or SEEDS)
    with live() as progress:
        study = run(out, cases=cases, workers=workers, tell_plan=typer.echo, progress=progress)
    for line in study.summary():
        typer.echo(line)
    if study.failures:
        raise typer.Exit(1)


for _command in (
    modelcommands.mesh,
    modelcommands.simulate,
    modelcommands.compare,
    modelcommands.drive,
    modelcommands.level,
    modelcommands.converge,
    modelcommands.fit,
):
    app.command()(_command)


@app.command()
def doctor() -> None:
    """Is this machine fit to run mrstrain?"""
    from mrstrain.doctor import examine

    def registration() -> str:
        from dvc.elastix import self_test
        from dvc.worker import Worker

        with Worker(threads=1) as worker:
            return worker.run("trying elastix", self_test)

    findings = examine(elastix_check=registration)
    for finding in findings:
        typer.echo(f"{'ok  ' if finding.ok else 'NOT '} {finding.what}: {finding.detail}")
        if not finding.ok and finding.advice:
            typer.echo(f"     {finding.advice}")
    if not all(f.ok for f in findings):
        raise typer.Exit(1)


def main() -> None:
    """Entry point: errors made on purpose are printed as sentences, with exit status 2."""
    if len(sys.argv) > 1 and not {"--help", "-h"} & set(sys.argv[1:]):
        from mrstrain.doctor import refuse_foreign_packages

        try:
            refuse_foreign_packages()  # before anything of dvc is imported: it might not be ours
        except ImportError as error:
            _stop(str(error))
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    # Being told to end is like an interrupt: what was started ends too, and nothing half-written stays.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        app()
    except Exception as error:
        from dvc.errors import MrstrainError

        if not isinstance(error, MrstrainError):
            raise
        _stop(str(error))


def _stop(message: str) -> None:
    typer.echo(f"mrstrain: {message}", err=True)
    sys.exit(2)
