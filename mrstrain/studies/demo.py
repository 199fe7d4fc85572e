"""`demo`: a complete study of a heel phantom with known strain, with the measurement error by tissue."""

import json
import time
from collections.abc import Mapping
from pathlib import Path

from dvc import read_labels, write_labels
from dvc.atomic_files import write_whole
from dvc.errors import InputError, OutputError
from dvc.io.result_folder import REPORT, read_maps
from dvc.own_files import read_json
from mrstrain.models.simulate import LOADS
from mrstrain.records.outcome import Outcome
from mrstrain.records.progress import ALL, OnProgress
from mrstrain.records.time_left import Expected, TimeLeft
from mrstrain.studies.file import FILE, Study, read_study
from mrstrain.studies.pipeline import StageOutcome
from mrstrain.studies.plan import REGISTRATION
from mrstrain.studies.run import StudyRun, run_studies
from mrstrain.studies.true_error import TABLE, read_errors, write_errors
from mrstrain.studies.watch import Follower, OnReport
from mrstrain.truth.phantom import TRUTH, phantom
from phantoms import Heel, TissueError, errors_of_maps, heel_grid, labels_of, labels_to_mesh

_SETS = ("trebbi", "erdemir", "akrami")
_ALL_SETS = ("trebbi", "akrami", "erdemir", "friedman", "luboz", "spears", "zwam")
_COARSE = "tissues_to_mesh_coarse"
_COARSE_MM = 1.2  # voxels of the label map that is meshed
_PHANTOM, _RUN = "phantom", "study"
_PHANTOM_S = 42.0  # on two idle cores
# Of the total time, for the coarse mesh (False) and the published size (True). On busy cores 0.17 and 0.27 were seen.
_PHANTOM_SHARE = {False: 0.22, True: 0.01}
_STUDY = """# Demonstration: a heel phantom whose strain is known at every point (see the folder truth).
[study]
name = "Phantom heel"
seed = {seed}

[images]
load0 = "Load0.nii.gz"
repeat = "Load0-again.nii.gz"
labels = "tissues.nii.gz"
names = "tissues.csv"

{loads}
[mesh]
edge_mm = {edge_mm}
labels = "{to_mesh}.nii.gz"
names = "{to_mesh}.csv"

[models]
sets = {sets}
{limit}"""
_LIMIT = "limit_minutes = 20  # for each load path; the set friedman, with the softest fat, would take hours\n"
_LOAD = """[loads.{name}]
image = "{name}.nii.gz"
normal_n = {normal_n}
shear_n = {shear_n}

"""


def demo(
    out: Path | str, *, seed: int = 1, full: bool = False, workers: int | None = None,
    progress: OnProgress | None = None, on_report: OnReport | None = None,
) -> Outcome:  # fmt: skip
    """Make a heel phantom under four loads, run its study, and compare the measurement with the truth.

    out: The study's folder: images and truth of the phantom, ``study.toml``, ``results`` and ``error.csv``. A second
        run in the same folder resumes.
    seed: Seed of the phantom.
    full: All seven published material sets on about 75,000 tetrahedra; otherwise three on a coarser mesh.
    workers, progress, on_report: As in `mrstrain.run`.
    Returns the summary. It is complete unless a stage failed; a load that a model does not reach is not a failure.
    Raises OutputError if the folder contains another phantom, or other files that would be overwritten.
    """
    target, began = Path(out), time.monotonic()
    making = None if progress is None else Making(progress, full, began)
    _make(target, seed, full, making)
    errors: dict[str, tuple[TissueError, ...]] = {}

    def compare(study: Study, outcomes: Mapping[str, StageOutcome]) -> None:
        errors.update(_errors(study, outcomes, read_errors(target / TABLE, outcomes)))
        write_errors(target / TABLE, errors, outcomes)

    follower = Follower(progress, on_report, compare, began, {} if making is None else making.done)
    (done,) = run_studies([read_study(target)], workers=workers, follower=follower)
    complete = all(_reached(outcome) for outcome in done.outcomes.values())
    return Outcome(done.study.out, tuple(_summary(errors, done)), complete)


class Making:
    """Reports how far the phantom is, and how far all is, by the time that the phantom took so far."""

    def __init__(self, progress: OnProgress, full: bool, began: float) -> None:
        self._progress, self._began = progress, began
        run_s = _PHANTOM_S * (1.0 / _PHANTOM_SHARE[full] - 1.0)
        self._left = TimeLeft({_PHANTOM: Expected(_PHANTOM_S), _RUN: Expected(run_s, before=(_PHANTOM,))}, 1)

    def __call__(self, case: str, stage: str, fraction: float) -> None:
        """Take the progress of the phantom."""
        self._left.told(_PHANTOM, stage, fraction)
        self._progress(case, stage, fraction)
        spent = time.monotonic() - self._began
        self._progress(ALL, "making the phantom", spent / (spent + self._left.seconds() + 1e-9))

    @property
    def done(self) -> dict[str, tuple[Expected, float]]:
        """What the phantom was expected to take, and took; empty if it was there before."""
        return {name: (self._left.stages[name], taken_s) for name, taken_s in self._left.took.items()}


def _make(target: Path, seed: int, full: bool, progress: OnProgress | None) -> None:
    """Write the phantom and its study file where they do not exist yet."""
    record = target / "phantom.json"
    heel = Heel(seed)
    if record.is_file():
        try:
            old = read_json(record)["parameters"]["seed"]
        except (OSError, ValueError, KeyError, TypeError) as failure:
            what = f"{record}: not the record of a phantom, or damaged ({failure!r})."
            raise InputError(f"{what} Choose another folder (out), or delete this one.") from failure
        if old != seed:
            raise OutputError(
                f"{target} contains the phantom of seed {old}; choose another folder (out) for seed {seed}."
            )
    else:
        own = sorted(p.name for p in target.iterdir()) if target.is_dir() else []
        if (target / FILE).exists() or any(name.startswith(("Load", "tissues", "calcaneus")) for name in own):
            raise OutputError(
                f"{target} contains files that the demonstration would overwrite; choose another folder (out)."
            )
        phantom(target, seed=seed, progress=progress)
    texts = {size: _text(seed, size) for size in (False, True)}
    study = target / FILE
    if study.exists() and study.read_text(encoding="utf-8", errors="replace") not in texts.values():
        return  # changed by the user; used unchanged
    if not full:
        grid = heel_grid(_COARSE_MM, heel.size)
        write_labels(target / f"{_COARSE}.nii.gz", labels_to_mesh(heel, labels_of(heel, grid)))
    write_whole(study, texts[full])


def _text(seed: int, full: bool) -> str:
    """Text of the study file, full or reduced."""
    loads = "".join(_LOAD.format(name=load.name, normal_n=load.normal_n, shear_n=load.shear_n or 0.0) for load in LOADS)
    return _STUDY.format(
        seed=seed, loads=loads, edge_mm=2.8 if full else 4.0, to_mesh="tissues_to_mesh" if full else _COARSE,
        sets=json.dumps(_ALL_SETS if full else _SETS), limit=_LIMIT if full else "",
    )  # fmt: skip


def _errors(
    study: Study, outcomes: Mapping[str, StageOutcome], known: Mapping[str, tuple[TissueError, ...]]
) -> dict[str, tuple[TissueError, ...]]:
    """Error of each load by tissue, where its strain is valid; ``known`` errors are not computed again."""
    labels = read_labels(study.path("tissues.nii.gz"), study.path("tissues.csv"))
    errors = {}
    for load in study.loads:
        if load in known:
            errors[load] = known[load]
        elif outcomes[f"register {load}"].record is not None:
            measured = read_maps(study.out / REGISTRATION / load)
            errors[load] = errors_of_maps(labels, read_maps(study.place / TRUTH / load), measured)
    return errors


def _reached(outcome: StageOutcome) -> bool:
    """Whether a stage has a result without a failure; a load that a model does not reach is not a failure."""
    return outcome.record is not None and not outcome.reason and not outcome.result.retry


def _summary(errors: dict[str, tuple[TissueError, ...]], done: StudyRun) -> list[str]:
    fat = {load: e for load, rows in errors.items() for e in rows if e.tissue == "fat"}
    lines = [
        "Verdicts on the registrations: " + "; ".join(f"{load}: {v.words}" for load, v in done.verdicts.items()),
        "RMSE of the max. shear in fat (true 95th percentile in brackets): "
        + ", ".join(f"{load} {e.shear_rmse:.3f} ({e.true_p95:.2f})" for load, e in fat.items()),
    ]
    lines += [
        line for line in done.outcomes["compare"].result.lines if line.startswith(("All loads", "Best match over"))
    ]
    for outcome in done.outcomes.values():
        if not outcome.complete:
            partly = [line for line in outcome.result.lines if "ONLY" in line]
            lines.append(f"{outcome.stage}: {outcome.status}. {outcome.reason or ' '.join(partly)}")
    return [*lines, f"Report: {done.study.out / REPORT}"]
