"""How a model was computed, and what it was calibrated with, from the records beside its results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from dvc.io.result_folder import PROVENANCE
from dvc.own_files import read_json
from fe import LoadStep
from mrstrain.records.provenance import read_record
from validate import LEVELLED

Kind = Literal["simulated", "driven", "levelled", "other"]
FITTED = " fitted to "
"""What the title of a material set that `fit` made has between the model's and the curve's name."""
_TAKEN_FROM_THE_MEASUREMENT = {
    "driven": (
        "measured displacement of the surface", "boundary conditions",
        "displacement of the skin and near it; only the strain inside is predicted",
    ),
    "levelled": (
        "unloaded image and registration", "simulated measurement of the model",
        "detail that the measurement smooths away, in model and measurement",
    ),
}  # fmt: skip
"""By kind of model: the data, what they were used for, and what they cannot validate."""


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """A model according to its records.

    Attributes
    ----------
    kind : str
        "simulated" under a plate, "driven" by the measured displacement of its surface, "levelled" (warped and
        registered like the measurement), or "other" (of another program).
    laws : mapping of str to str
        Constitutive model of each region.
    title : str
        Where the parameters are from.
    element, mesh : str
        Finite element, and how the mesh was made; empty if not known.
    steps : tuple of LoadStep
        Loads, with forces (N) or displacements (mm) of the plate.
    reached : mapping of str to float
        Fraction of each load that was reached.
    """

    name: str
    kind: Kind
    laws: Mapping[str, str]
    title: str = ""
    element: str = ""
    mesh: str = ""
    steps: tuple[LoadStep, ...] = ()
    reached: Mapping[str, float] | None = None

    @classmethod
    def read(cls, name: str, folder: Path) -> Self:
        """The facts of a model in its folder; one without a record that can be read is "other"."""
        try:
            return cls._of(name, folder, read_json(folder / "simulation.json"))
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            own = read_record(folder / PROVENANCE).get("command") == "level" or name.endswith(LEVELLED)
            return cls(name, "levelled" if own else "other", {})

    @classmethod
    def _of(cls, name: str, folder: Path, record: Mapping[str, Any]) -> Self:
        if record["command"] == "drive":
            laws = {str(region): str(law) for region, law in record["laws"].items()}
            return cls(name, "driven", laws, str(record.get("title", record["set"])))
        given = record["parameters"]
        made = given.get("mesh_made")
        return cls(
            name, "simulated", {str(region): str(law["law"]) for region, law in given["laws"].items()},
            title=str(given["title"]), element=str(given["element"]).partition(":")[0],
            mesh="" if not made else f"made from the label map, requested edge length {made['edge_mm']:g} mm",
            steps=tuple(LoadStep(**step) for path in given["paths"] for step in path),
            reached={load: float(of["reached"]) for load, of in record["outcome"].items()},
        )  # fmt: skip

    @property
    def fitted_to(self) -> str:
        """The curves that its parameters were fitted to; empty if they were not."""
        return self.title.partition(FITTED)[2]


def facts_of(folders: Mapping[str, Path]) -> tuple[ModelFacts, ...]:
    """The facts of models in their folders, by name."""
    return tuple(ModelFacts.read(name, folder) for name, folder in folders.items())


def used_for_calibration(models: Sequence[ModelFacts]) -> list[tuple[str, str, str]]:
    """Data that models were calibrated with: model and data, what they were used for, and what they cannot validate."""
    rows = [
        (f"{one.name}: {one.title}", "material parameters", f"the stress of the tests in {one.fitted_to}")
        for one in models
        if one.fitted_to
    ]
    for kind, (data, use, invalid) in _TAKEN_FROM_THE_MEASUREMENT.items():
        rows += [(f"{one.name}: {data}", use, invalid) for one in models if one.kind == kind]
    moved = {step.name: step for one in models for step in one.steps if (step.normal_mm, step.shear_mm) != (None, None)}
    rows += [
        (
            f"{load}: displacement of the plate ({step})", "load",
            "displacement of the plate and of the skin on it, if it was taken from these images",
        )
        for load, step in moved.items()
    ]  # fmt: skip
    return rows
