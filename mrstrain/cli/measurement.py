"""The commands that measure strain, and those that measure how accurately: phantoms, synthetic warps, their study."""

from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.options import FieldFrame, Out, Workers, carry_out, takes_options, tell
from mrstrain.options.measurement import MeshAndAxes, RegistrationOptions, Running, Scans, SubjectFiles
from mrstrain.options.modelling import HeelShape

SliceSpacing = Annotated[float | None, typer.Option(help="Their edge along the third axis, where it is another, mm.")]


@takes_options
def register(
    load0: Annotated[Path, typer.Argument(help="Unloaded image: NIfTI, NRRD, MHA, enhanced DICOM, or a DICOM folder.")],
    loads: Annotated[list[Path], typer.Argument(help="Loaded images.")], out: Out, subject_files: SubjectFiles,
    registration: RegistrationOptions, scans: Scans, onto: MeshAndAxes, running: Running,
) -> None:  # fmt: skip
    """Displacement and strain of loaded images against the unloaded one, with quality and a report."""
    carry_out(
        mrstrain.register.with_options, load0, loads, out=out, subject_files=subject_files, registration=registration,
        scans=scans, onto=onto, running=running,
    )  # fmt: skip


@takes_options
def strain(
    reference: Annotated[Path, typer.Argument(help="Unloaded image: gives the grid.")],
    deformation: Annotated[
        Path, typer.Argument(help="elastix transform .txt, ITK transform (.h5, .tfm), or a displacement image.")
    ],
    out: Out, subject_files: SubjectFiles, onto: MeshAndAxes, frame: FieldFrame = None,
) -> None:  # fmt: skip
    """Strain maps from a transform or displacement field that any tool has made."""
    given = mrstrain.strain.with_options
    tell(given(reference, deformation, out=out, subject_files=subject_files, frame=frame, onto=onto))


@takes_options
def phantom(
    out: Out, seed: Annotated[int, typer.Option(min=0, help="Of shapes, textures, noise and the foot's motions.")] = 1,
    load: Annotated[
        list[str] | None, typer.Option(help="Load1, Load2, Load3 or Load4; repeat for several. Default: all.")
    ] = None,
    spacing: Annotated[float, typer.Option(help="Edge of the voxels, mm.")] = 0.8, slice_spacing: SliceSpacing = None,
    snr: Annotated[float, typer.Option(help="Fat's signal over the noise's standard deviation.")] = 25.0,
    no_noise: Annotated[bool, typer.Option("--no-noise", help="Images without noise.")] = False, *, shape: HeelShape,
) -> None:  # fmt: skip
    """Images of a synthetic heel under Load0 to Load4, with their exactly known strain."""
    from phantoms import LOADS

    edges = (spacing, spacing, spacing if slice_spacing is None else slice_spacing)
    carry_out(
        mrstrain.phantom.with_options, out, seed=seed, loads=load or tuple(LOADS), spacing_mm=edges,
        snr=None if no_noise else snr, shape=shape,
    )  # fmt: skip


@takes_options
def twin(
    load0: Annotated[Path, typer.Argument(help="Unloaded image of your own.")],
    deformation: Annotated[
        Path,
        typer.Argument(help="The whole motion: elastix .txt, ITK transform (.h5, .tfm), or a displacement image."),
    ],
    out: Out, subject_files: SubjectFiles, frame: FieldFrame = None,
    seed: Annotated[int, typer.Option(min=0, help="Of noise and bias field.")] = 1,
) -> None:  # fmt: skip
    """A loaded image made of your own unloaded one, with the truth beside it: to see how well that is found."""
    tell(mrstrain.twin.with_options(load0, deformation, out=out, subject_files=subject_files, frame=frame, seed=seed))


def accuracy(
    out: Out,
    preset: Annotated[
        list[str] | None,
        typer.Option(help="gauss-newton, gauss-newton-borders (labels), elastix' preset or file (.txt); repeatable."),
    ] = None,
    spacing: Annotated[list[float] | None, typer.Option(help="Edge of the voxels, mm; repeat for several.")] = None,
    slice_spacing: SliceSpacing = None,
    snr: Annotated[list[float] | None, typer.Option(help="Signal-to-noise ratio; repeat for several.")] = None,
    motion: Annotated[
        list[str] | None,
        typer.Option(help="still, smooth, sliding, swelling, Load1 to Load4, wave-L (L mm); repeat for several."),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(min=0, help="Heel; repeat for several. Default: 1 and 2. 9000 to 9999 are for published figures."),
    ] = None,
    workers: Workers = None,
) -> None:
    """Error of a preset or engine on phantoms: by tissue, place, strain, noise, resolution. Goes on where it stopped.

    Without options 110 registrations: gauss-newton, seven motions and eight waves, voxels of 0.8 mm at SNR 25, 12 and
    50, of 1.2 mm and of 0.8 x 0.8 x 1.6 mm at SNR 25. With --spacing or --snr these alone (default 0.8 mm, 25).
    """
    from dvc.registration.engines import DEFAULT
    from mrstrain.truth.accuracy import CONDITIONS, MOTIONS, SEEDS, WAVES

    conditions = CONDITIONS
    if spacing or snr or slice_spacing:
        conditions = tuple(((s, s, slice_spacing or s), r) for s in spacing or [0.8] for r in snr or [25.0])
    motions = motion or (*MOTIONS, *WAVES)
    cases = mrstrain.accuracy_cases(preset or (DEFAULT,), conditions, motions, seed or SEEDS)
    carry_out(mrstrain.accuracy, out, cases=cases, workers=workers, tell_plan=typer.echo)
