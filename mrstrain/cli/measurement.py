"""The commands that measure: from images, or what another tool made of them, to strain."""

from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.options import FieldFrame, Out, carry_out, takes_options, tell
from mrstrain.options.measurement import MeshAndAxes, RegistrationOptions, Running, Scans, SubjectFiles


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
