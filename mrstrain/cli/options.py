"""The options that several commands share."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Align(StrEnum):
    """What is aligned rigidly before the non-rigid registration."""

    BONE = "bone"
    IMAGE = "image"
    NONE = "none"


class Engine(StrEnum):
    """What finds the non-rigid part of a registration."""

    ELASTIX = "elastix"
    GAUSS_NEWTON = "gauss-newton"


class Frame(StrEnum):
    """Frame of coordinates in a mesh or landmark file."""

    LPS = "LPS"
    RAS = "RAS"


class Unit(StrEnum):
    """Unit of lengths in a mesh file."""

    MM = "mm"
    M = "m"


Out = Annotated[Path, typer.Option(help="Folder for the results; made where it is missing.")]
Bone = Annotated[Path | None, typer.Option(help="Mask of the bone whose motion is taken out, on the unloaded image.")]
BoneLabel = Annotated[str | None, typer.Option(help="Or: the name of the bone in --labels.")]
Tissue = Annotated[Path | None, typer.Option(help="Mask of the body; found by a threshold where it is not given.")]
Labels = Annotated[Path | None, typer.Option(help="Label map of the tissues on the unloaded image.")]
Names = Annotated[Path | None, typer.Option(help="Names of the labels: ITK-SNAP or Slicer table, or CSV.")]
Plate = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        help="The plate's outward normal, away from the foot, LPS; default, patient inferior: --plate-normal 0 0 -1."
    ),
]
Shear = Annotated[
    tuple[float, float, float] | None,
    typer.Option(help="Direction of the shear force on the tissue, LPS, such as --shear-direction 0 -1 0 (anterior)."),
]
ModelMesh = Annotated[Path | None, typer.Option(help="Mesh of nodal displacements in .csv files.")]
MeshFile = Annotated[Path | None, typer.Option(help="Mesh to put displacement and strain on.")]
MeshUnit = Annotated[Unit, typer.Option(help="Unit of the mesh's coordinates.")]
MeshFrame = Annotated[Frame, typer.Option(help="Frame of the mesh's coordinates.")]
EngineName = Annotated[
    Engine | None,
    typer.Option("--engine", help="What finds the non-rigid part. Default: gauss-newton; with --preset, elastix."),
]
Preset = Annotated[str | None, typer.Option(help="Named parameters of elastix, such as heel-mr.")]
Parameters = Annotated[
    list[Path] | None, typer.Option(help="elastix parameter file(s) of your own, instead of a preset.")
]
Bending = Annotated[
    float | None,
    typer.Option(help="gauss-newton: weight of bending, 1/mm. Default: chosen for each pair by cross-validation."),
]
Borders = Annotated[
    bool | None,
    typer.Option(
        help="gauss-newton: strain may jump where the tissues of --labels meet. Default: where there are labels; "
        "--no-borders for labels that are off by more than a voxel."
    ),
]
Volume = Annotated[
    float | None,
    typer.Option(help="gauss-newton: weight of the change of volume, 1/mm3. Default: 300, or as the images ask."),
]
FieldFrame = Annotated[
    Frame | None, typer.Option(help="Frame of a displacement image's components, where no JSON beside it tells.")
]
Start = Annotated[
    Path | None,
    typer.Option(help="What another tool found for one load, to be refined: a transform or displacement image."),
]
StartFrame = Annotated[Frame | None, typer.Option(help="Frame of --start, where its file does not tell it.")]
