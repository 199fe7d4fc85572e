"""The stages of a study, each a function of plain values and paths that a worker runs on this or another machine.

Every function takes ``tell(stage, fraction)`` and the arguments from the plan, writes its results completely, and
returns its contribution to the report and the log.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from dvc import Verdict
from dvc.report.page import Section
from mrstrain.options.model import Options
from mrstrain.records.progress import NOTE
from mrstrain.records.time_left import WRITING

_M = TypeVar("_M", bound=Options)
Tell = Callable[[str, float], None]
_PARTS = {
    "aligning": (0.0, 0.3), "registering": (0.3, 0.5), "strain and figures": (0.8, 0.2),
    "reading": (0.0, 0.2), "comparing": (0.2, 0.47), "writing": (0.67, 0.33),
    "meshing": (0.0, 1.0),
}  # fmt: skip
# of the time of a registration or a comparison: when each of its parts begins, and how much of it the part takes
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

    make = labelled_by_command if "command" in options else run
    done = make(load0, out=out, watch=lambda share: tell("tissues", share), **options)
    return StageResult(tuple(done.summary()[:-1]), (done.section,), headline=done.headline)


def register(tell: Tell, *, load0: Path, load: Path, repeat: Sequence[Path], **options: Any) -> StageResult:
    """Register one loaded image; as `mrstrain.measurement.register.register_one`."""
    from mrstrain.measurement.register import register_one

    case = register_one(load0, load, repeat=next(iter(repeat), None), tell=_whole(tell), **options)
    return StageResult(tuple(case.summary()), (case.section,), headline=case.headline)


def _whole(tell: Tell) -> Tell:
    """Progress of parts as that of the whole; a part without a known share leaves it as it is."""
    reached = 0.0

    def told(part: str, fraction: float) -> None:
        nonlocal reached
        begin, share = _PARTS.get(part, (reached, 0.0))
        reached = max(reached, begin + share * fraction)
        tell(part, reached)

    return told


def mesh(tell: Tell, *, labels: Path, ratio: float | None = None, **options: Any) -> StageResult:
    """Mesh the soft tissue of a label map; as `mrstrain.mesh`, or with edges that are longer by a ratio."""
    from mrstrain.models.mesh import mesh as run, mesh_coarser
    from mrstrain.options.modelling import Labelling, Meshing

    whole = _whole(tell)

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
    from fe import LoadStep
    from mrstrain.models.vary import vary as run
    from mrstrain.options.modelling import MeshCoordinates, PlateOptions, SimulationOptions
    from mrstrain.options.uncertainty import Uncertainty

    voxel_mm = float(read_labels(labels, names).grid.voxel_volume_mm3 ** (1 / 3))
    simulation, plate = _chosen(SimulationOptions, options), _chosen(PlateOptions, options)
    done = run(
        mesh, simulation=simulation, plate_options=plate, coordinates=_chosen(MeshCoordinates, options),
        loads=[LoadStep(**load) for load in loads], uncertainty=Uncertainty.of(uncertainty), voxel_mm=voxel_mm,
        tell=tell, **options,
    )  # fmt: skip
    return StageResult(tuple(done.summary()), complete=done.complete, headline=done.lines[0])


def drive(tell: Tell, *, mesh: Path, dvc: Path, **options: Any) -> StageResult:
    """Simulate one material set with measured boundary conditions; as `mrstrain.drive`."""
    from mrstrain.comparison.drive import drive as run

    done = run(mesh, dvc, threads=1, progress=lambda _, *stage: tell(*stage), **options)
    return StageResult(tuple(done.summary()[:-1]), complete=done.complete)


def level(tell: Tell, *, load0: Path, model: Path, load: str, **options: Any) -> StageResult:
    """Forward-model comparison of one model and load; as `mrstrain.level`."""
    from mrstrain.comparison.level import level as run

    whole = _whole(tell)
    done = run(load0, model, loads=[load], threads=1, progress=lambda _, *stage: whole(*stage), **options)
    return StageResult(tuple(done.summary()[:-1]))


def compare(tell: Tell, **options: Any) -> StageResult:
    """Compare all models with the measurement; as `mrstrain.compare`, on all cores, since it is the last stage."""
    from mrstrain.comparison.compare import compare as run

    models = [*dict.fromkeys(options.pop("models", [])), *options.pop("elsewhere")]
    variants = [*options.pop("variants", []), *options.pop("variants_elsewhere", [])]
    remarks = [_LEFT_OUT] if options.pop("quick", False) else []
    whole = _whole(tell)
    done = run(
        options.pop("dvc"), models, variants=variants, remarks=remarks, progress=lambda _, *stage: whole(*stage),
        **options,
    )  # fmt: skip
    return StageResult(tuple(done.summary()[:-1]), done.sections, done.closing, headline=done.comparison.headline)
