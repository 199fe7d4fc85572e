"""The stages of a study, each a function of plain values and paths that a worker runs on this or another machine.

Every function takes ``tell(stage, fraction)`` and the arguments from the plan, writes its results completely, and
returns its contribution to the report and the log.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dvc import Verdict
from dvc.errors import InputError
from dvc.report.page import Section
from mrstrain.options.model import Options
from mrstrain.records.durations import MESHING, TISSUES, comparison, usual_registration
from mrstrain.records.progress import NOTE
from mrstrain.records.time_left import WRITING, Expected

if TYPE_CHECKING:
    from dvc import Engine

_M = TypeVar("_M", bound=Options)
Tell = Callable[[str, float], None]
_LEFT_OUT = (
    "The input uncertainty of the models was skipped (quick): intervals and significant differences treat mesh, "
    "forces, directions and parameters of simulated models as exact."
)


@dataclass(frozen=True, slots=True)
class StageResult:
    """Result of a stage."""

    lines: tuple[str, ...]  # summary
    sections: tuple[Section, ...] = ()  # of the study's report
    closing: tuple[Section, ...] = ()  # at the end of the report: how to read its part
    complete: bool = True  # False if a model reached only a part of its load
    retry: bool = False  # a part failed in a way that may not recur, so it is run again next time
    headline: str = ""  # the result in one line

    @property
    def verdicts(self) -> list[Verdict]:
        """The verdicts in its sections."""
        return [section.verdict for section in self.sections if section.verdict is not None]


def label(tell: Tell, *, load0: Path, out: Path, **options: Any) -> StageResult:
    """Make the label map from the unloaded image; as `mrstrain.label`, or by a command."""
    from mrstrain.measurement.label import label as run
    from mrstrain.measurement.label_command import labelled_by_command

    if "command" in options:
        done = labelled_by_command(load0, out=out, watch=partial(tell, TISSUES), **options)
    else:
        whole = _whole(tell, Expected.of({TISSUES: 1.0}))
        done = run(load0, out=out, progress=lambda _, *stage: whole(*stage), **options)
    return StageResult(tuple(done.summary()[:-1]), (done.section,), headline=done.headline)


def register(tell: Tell, *, load0: Path, load: Path, repeat: Sequence[Path], **options: Any) -> StageResult:
    """Register one loaded image; as `mrstrain.measurement.register.register_one`."""
    from mrstrain.measurement.register import register_one

    whole = _whole(tell, usual_registration(_engine(options).cost, twin=bool(options.get("twin"))))
    case = register_one(load0, load, repeat=next(iter(repeat), None), tell=whole, **options)
    return StageResult(tuple(case.summary()), (case.section,), headline=case.headline)


def _whole(tell: Tell, expected: Expected) -> Tell:
    """Progress of parts as that of the whole; a part that is not expected leaves it as it is."""
    reached = 0.0

    def told(part: str, fraction: float) -> None:
        nonlocal reached
        reached = max(reached, expected.share(part, fraction))
        tell(part, reached)

    return told


def _engine(options: Mapping[str, Any]) -> "Engine":
    """The engine of a registration with such options."""
    from mrstrain.measurement.engines import engine_of
    from mrstrain.options.measurement import RegistrationOptions

    chosen = {name: options[name] for name in RegistrationOptions.model_fields if name in options}
    return engine_of(RegistrationOptions.of(chosen), labelled=True)


def mesh(tell: Tell, *, labels: Path, ratio: float | None = None, **options: Any) -> StageResult:
    """Mesh the soft tissue of a label map; as `mrstrain.mesh`, or with edges that are longer by a ratio."""
    from mrstrain.models.mesh import mesh as run, mesh_coarser
    from mrstrain.options.modelling import Labelling, Meshing

    whole = _whole(tell, Expected.of({MESHING: 1.0}))

    def told(_: str, part: str, fraction: float) -> None:
        whole(part, fraction)

    if ratio is None:
        lines = run(labels, progress=told, **options).summary()
    else:
        how, which = _chosen(Meshing, options), _chosen(Labelling, options)
        lines = mesh_coarser(labels, ratio=ratio, labelling=which, meshing=how, progress=told, **options).summary()
    return StageResult(tuple(lines), headline=lines[0])


def _chosen(model: type[_M], options: dict[str, Any]) -> _M:
    """A model of options, whose fields are taken out of the others."""
    return model.of({name: options.pop(name) for name in model.model_fields if name in options})


def simulate(tell: Tell, *, mesh: Path, loads: Sequence[Mapping[str, Any]], **options: Any) -> StageResult:
    """Simulate one material set under all loads; as `mrstrain.simulate`."""
    from fe import LoadStep
    from mrstrain.models.simulate import simulate as run

    steps = [LoadStep(**load) for load in loads]
    begun: dict[str, float] = {}

    def told(case: str, stage: str, fraction: float) -> None:
        if case == NOTE or stage == WRITING:  # a note is in the summary, too
            return
        begun[case] = fraction
        tell(stage, sum(begun.values()) / max(len(begun), 2 if len(loads) > 1 else 1))

    done = run(mesh, loads=steps, workers=1, threads=1, progress=told, **options)
    headline = "; ".join(one.headline for one in done.sets)
    return StageResult(tuple(done.summary()[:-1]), complete=done.complete, retry=bool(done.failures), headline=headline)


def vary(
    tell: Tell, *, mesh: Path, labels: Path, names: Path | None, loads: Sequence[Mapping[str, Any]],
    uncertainty: Mapping[str, Any], **options: Any,
) -> StageResult:  # fmt: skip
    """Solve a material set with one input changed at a time; as `mrstrain.models.vary.vary`."""
    from dvc import read_labels
    from dvc.labelling.boundary_position import position_sd_mm
    from fe import LoadStep
    from mrstrain.measurement.label_files import read_made
    from mrstrain.models.vary import vary as run
    from mrstrain.options.modelling import MeshCoordinates, PlateOptions, SimulationOptions
    from mrstrain.options.uncertainty import Uncertainty

    voxel_mm, notes = float(read_labels(labels, names).grid.voxel_volume_mm3 ** (1 / 3)), list[str]()
    try:
        made = read_made(labels, names)
    except InputError as lacking:  # only the boundaries of bone and skin are uncertain then
        made = None
        notes.append(str(lacking))
    simulation, plate = _chosen(SimulationOptions, options), _chosen(PlateOptions, options)
    done = run(
        mesh, simulation=simulation, plate_options=plate, coordinates=_chosen(MeshCoordinates, options),
        loads=[LoadStep(**load) for load in loads], uncertainty=Uncertainty.of(uncertainty), voxel_mm=voxel_mm,
        boundaries_mm=None if made is None else position_sd_mm(made), tell=tell, **options,
    )  # fmt: skip
    return StageResult((*notes, *done.summary()), complete=done.complete, headline=done.lines[0])


def drive(tell: Tell, *, mesh: Path, dvc: Path, **options: Any) -> StageResult:
    """Simulate one material set with measured boundary conditions; as `mrstrain.drive`."""
    from mrstrain.comparison.drive import drive as run

    done = run(mesh, dvc, threads=1, progress=lambda _, *stage: tell(*stage), **options)
    return StageResult(tuple(done.summary()[:-1]), complete=done.complete)


def level(tell: Tell, *, load0: Path, model: Path, load: str, **options: Any) -> StageResult:
    """Forward-model comparison of one model and load; as `mrstrain.level`."""
    from mrstrain.comparison.level import level as run

    engine = _engine(options | {"allow_unknown_parameters": True})
    whole = _whole(tell, usual_registration(engine.cost))
    done = run(load0, model, loads=[load], threads=1, progress=lambda _, *stage: whole(*stage), **options)
    return StageResult(tuple(done.summary()[:-1]))


def compare(tell: Tell, **options: Any) -> StageResult:
    """Compare all models with the measurement; as `mrstrain.compare`, on all cores, since it is the last stage."""
    from mrstrain.comparison.compare import compare as run

    models = [*dict.fromkeys(options.pop("models", [])), *options.pop("elsewhere")]
    variants = [*options.pop("variants", []), *options.pop("variants_elsewhere", [])]
    remarks = [_LEFT_OUT] if options.pop("quick", False) else []
    whole = _whole(tell, comparison([1], 1))
    done = run(
        options.pop("dvc"), models, variants=variants, remarks=remarks, progress=lambda _, *stage: whole(*stage),
        **options,
    )  # fmt: skip
    return StageResult(tuple(done.summary()[:-1]), done.sections, done.closing, headline=done.comparison.headline)
