"""The commands that measure strain, and those that measure its error: phantoms, synthetic warps, their study."""

from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.lines import say
from mrstrain.cli.options import FieldFrame, Out, Workers, carry_out, takes_options, tell
from mrstrain.options.measurement import (
    BoneAndBody,
    ExistingFiles,
    GivenLabels,
    Marks,
    MarksForAuto,
    MeshAndAxes,
    RegistrationOptions,
    Running,
    Scans,
    SubjectFiles,
)
from mrstrain.options.modelling import HeelShape

Load0 = Annotated[
    Path, typer.Argument(help="Unloaded image: NIfTI, NRRD, MetaImage, enhanced DICOM, or a DICOM folder.")
]
SliceSpacing = Annotated[
    float | None, typer.Option(help="Voxel edge along the third axis, mm. Default: the same as --spacing.")
]


@takes_options
def label(
    load0: Load0,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Label map to write: .nii.gz, .nii, .nrrd or .mha. Other files of the same name, among them a .log, "
            "are also written.",
            rich_help_panel="Output",
        ),
    ] = None,
    draw: Annotated[
        Path | None,
        typer.Option(
            help="Write only a page (.html) for drawing the strokes of --marks in a browser, offline.",
            rich_help_panel="Output",
        ),
    ] = None,
    masks: BoneAndBody, strokes: Marks, drawn: GivenLabels,
) -> None:  # fmt: skip
    """Make a label map of skin, fat, muscle and bones from the unloaded image, with a bone mask or a few strokes.

    With --from and --labels, transfer the label map of another subject; with --labels alone or with --marks, correct an
    existing label map of this image.
    """
    from dvc.errors import InputError

    if draw is not None:
        if out is not None or masks.paths or strokes.paths or drawn.paths:
            raise InputError("--draw writes only the page to draw on: give it without --out and other files.")
        return tell(mrstrain.draw_strokes(load0, out=draw))
    if out is None:
        raise InputError("Give the label map to write: --out tissues.nii.gz (or a page to draw on: --draw page.html).")
    carry_out(mrstrain.label.with_options, load0, out=out, masks=masks, strokes=strokes, drawn=drawn)


@takes_options
def register(
    load0: Load0,
    loads: Annotated[list[Path], typer.Argument(help="Loaded images.")], out: Out, subject_files: SubjectFiles,
    strokes: MarksForAuto, registration: RegistrationOptions, scans: Scans, onto: MeshAndAxes, running: Running,
) -> None:  # fmt: skip
    """Measure displacement and strain between an unloaded image and loaded ones, with a verdict and a report."""
    from dvc.worker import Worker

    pairs = 1 if registration.chain else len(loads) + (scans.repeat is not None)
    with Worker(running.shares(max(1, pairs))[1]) as worker:
        # While this process imports all that reads, judges, draws and writes.
        worker.start("dvc.registration.align", "dvc.registration.gauss_newton.engine")
        carry_out(
            mrstrain.register.with_options, load0, loads, out=out, subject_files=subject_files,
            strokes=strokes, registration=registration, scans=scans, onto=onto, running=running, worker=worker,
        )  # fmt: skip


@takes_options
def strain(
    load0: Annotated[Path, typer.Argument(help="Unloaded image; strain is computed on its voxels.")],
    deformation: Annotated[
        Path, typer.Argument(help="elastix transform .txt, ITK transform (.h5, .tfm), or a displacement image.")
    ],
    out: Out, subject_files: ExistingFiles, onto: MeshAndAxes, frame: FieldFrame = None,
) -> None:  # fmt: skip
    """Compute strain maps from a transform or displacement field of any registration program."""
    given = mrstrain.strain.with_options
    tell(given(load0, deformation, out=out, subject_files=subject_files, frame=frame, onto=onto))


@takes_options
def phantom(
    out: Out, seed: Annotated[int, typer.Option(min=0, help="Seed of shapes, textures, noise and rigid motions.")] = 1,
    load: Annotated[
        list[str] | None, typer.Option(help="Load1, Load2, Load3 or Load4. Default: all. Repeat for several.")
    ] = None,
    spacing: Annotated[float, typer.Option(help="Voxel edge, mm.")] = 0.8, slice_spacing: SliceSpacing = None,
    snr: Annotated[float, typer.Option(help="Signal of fat over the standard deviation of the noise.")] = 25.0,
    no_noise: Annotated[bool, typer.Option("--no-noise", help="Images without noise.")] = False, *, shape: HeelShape,
) -> None:  # fmt: skip
    """Make images of a heel phantom, unloaded (Load0) and under loads (Load1 to Load4), with exactly known strain."""
    from phantoms import LOADS

    edges = (spacing, spacing, spacing if slice_spacing is None else slice_spacing)
    carry_out(
        mrstrain.phantom.with_options, out, seed=seed, loads=load or tuple(LOADS), spacing_mm=edges,
        snr=None if no_noise else snr, shape=shape,
    )  # fmt: skip


@takes_options
def twin(
    load0: Annotated[Path, typer.Argument(help="Your own unloaded image.")],
    deformation: Annotated[
        Path,
        typer.Argument(
            help="Total deformation to apply, including the rigid motion of the bone: elastix .txt, ITK transform "
            "(.h5, .tfm), or a displacement image."
        ),
    ],
    out: Out, subject_files: ExistingFiles, frame: FieldFrame = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and bias field.")] = 1,
) -> None:  # fmt: skip
    """Make a synthetic warp of your own unloaded image, with its exact strain, to test a registration."""
    tell(mrstrain.twin.with_options(load0, deformation, out=out, subject_files=subject_files, frame=frame, seed=seed))


def accuracy(
    out: Out,
    preset: Annotated[
        list[str] | None,
        typer.Option(
            help="Engine or elastix preset to test: gauss-newton-bone (as with a bone mask alone), "
            "gauss-newton-borders (as with labels), gauss-newton (one smooth spline), heel-mr, or an elastix parameter "
            "file (.txt). Default: gauss-newton-bone. Repeat for several."
        ),
    ] = None,
    spacing: Annotated[list[float] | None, typer.Option(help="Voxel edge, mm. Repeat for several.")] = None,
    slice_spacing: SliceSpacing = None,
    snr: Annotated[list[float] | None, typer.Option(help="Signal-to-noise ratio. Repeat for several.")] = None,
    motion: Annotated[
        list[str] | None,
        typer.Option(
            help="Motion of the phantom's tissue: still (none, to measure the noise floor), smooth, sliding (of the "
            "fat pad), swelling (the volume changes), Load1 to Load4, attached-Load1, attached-Load3 (tissue attached "
            "to bone), or wave-L (shear wave, wavelength L in mm; not with gauss-newton-bone and -borders). Default: "
            "all but swelling, and eight waves with the other presets. Repeat for several."
        ),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(
            min=0,
            help="Seed of the heel. Default: 1 and 2; 9000 to 9999 are for published results. Repeat for several.",
        ),
    ] = None,
    workers: Workers = None,
) -> None:
    """Measure the error of an engine or preset on phantoms, by tissue, position and strain; also noise and resolution.

    By default 90 registrations with gauss-newton-bone: nine motions of two heels, each with voxels of 0.8 mm at SNR
    25, 12 and 50, and with voxels of 1.2 mm and of 0.8 x 0.8 x 1.6 mm at SNR 25. Presets that do not keep the
    bone rigid, such as gauss-newton (one smooth spline), also get eight shear waves: the spatial resolution. --spacing
    and --snr replace these conditions: without --spacing, voxels are then 0.8 mm; without --snr, the SNR is 25. An
    interrupted run resumes.
    """
    from mrstrain.measurement.engines import AT_BONE
    from mrstrain.truth.accuracy import CONDITIONS, SEEDS

    conditions = CONDITIONS
    if spacing or snr or slice_spacing:
        conditions = tuple(((s, s, slice_spacing or s), r) for s in spacing or [0.8] for r in snr or [25.0])
    cases = mrstrain.accuracy_cases(preset or (AT_BONE,), conditions, motion, seed or SEEDS)
    carry_out(mrstrain.accuracy, out, cases=cases, workers=workers, tell_plan=say)
