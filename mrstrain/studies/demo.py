"""`demo`: a heel phantom whose strain is known, taken through a whole study, with the error told by tissue."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dvc.atomic_files import write_whole
from dvc.errors import OutputError
from dvc.io.images.labels import read_labels, read_mask
from dvc.io.images.write import write_labels
from dvc.io.result_folder import REPORT, VALID, spline_in
from mrstrain.models.loads import LOADS
from mrstrain.studies.file import FILE
from mrstrain.studies.page import write_run_report
from mrstrain.studies.pipeline import Outcome
from mrstrain.studies.plan import REGISTRATION
from mrstrain.studies.run import Ran, run
from mrstrain.studies.true_error import TABLE, read_errors, write_errors
from mrstrain.truth.phantom import phantom
from phantoms.anatomy import Heel
from phantoms.heel import heel_grid, labels_of, labels_to_mesh, under_load
from phantoms.tissue_error import TissueError, errors_by_tissue

Told = Callable[[str, str, float], None]

_SETS = ("trebbi", "luboz", "akrami")
_ALL_SETS = ("trebbi", "akrami", "erdemir", "friedman", "luboz", "spears", "zwam")
_COARSE = "tissues_to_mesh_coarse"
_COARSE_MM = 1.2  # voxels of the label map that is meshed
_STUDY = """# The demonstration: a phantom heel, whose strain is known at every point (see the folder truth).
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
_LIMIT = "limit_minutes = 20  # for each path of loads: Friedman's fat, the softest, would take hours\n"
_LOAD = """[loads.{name}]
image = "{name}.nii.gz"
normal_n = {normal_n}
shear_n = {shear_n}

"""


@dataclass(frozen=True, slots=True)
class Shown:
    """What `demo` gave: lines for a person, the report's path last, and whether every stage has a result.

    One that nothing but a limit of time ended has one.
    """

    lines: tuple[str, ...]
    complete: bool


def demo(
    out: Path | str,
    *,
    seed: int = 1,
    full: bool = False,
    workers: int | None = None,
    progress: Told | None = None,
) -> Shown:
    """Make a heel phantom under four loads, run its study, and compare the measurement with the truth.

    Parameters
    ----------
    out : path
        A study's folder: the phantom's images and truth, ``study.toml``, ``results`` and ``error.csv``. Run again in
        the same folder, it goes on where it stopped.
    seed : int
        Of the phantom.
    full : bool
        The published size: all seven material sets on some 75,000 tetrahedra; else three on a coarser mesh.
    workers, progress
        As in `mrstrain.run`.

    Returns
    -------
    Shown

    Raises
    ------
    OutputError
        If the folder holds another phantom, or files of somebody's own.
    """
    target = Path(out)
    _make(target, seed, full, progress)
    ran = run(target, workers=workers, progress=progress)
    errors = _errors(target, seed, ran, read_errors(target / TABLE, ran.outcomes))
    write_errors(target / TABLE, errors, ran.outcomes)
    write_run_report(target / "results" / REPORT, ran.study, ran.outcomes)
    return Shown(tuple(_told(errors, ran)), all(_reached(outcome) for outcome in ran.outcomes.values()))


def _make(target: Path, seed: int, full: bool, progress: Told | None) -> None:
    """Write the phantom and its study file, if they are not there."""
    made = target / "phantom.json"
    heel = Heel(seed)
    if made.is_file():
        old = json.loads(made.read_text(encoding="utf-8"))["parameters"]["seed"]
        if old != seed:
            raise OutputError(f"{target} holds the phantom of seed {old}; choose another --out for seed {seed}.")
    else:
        own = sorted(p.name for p in target.iterdir()) if target.is_dir() else []
        if (target / FILE).exists() or any(name.startswith(("Load", "tissues", "calcaneus")) for name in own):
            raise OutputError(f"{target} holds files that the demonstration would replace; choose another --out.")
        phantom(target, seed=seed, progress=progress)
    texts = {size: _text(seed, size) for size in (False, True)}
    study = target / FILE
    if study.exists() and study.read_text(encoding="utf-8") not in texts.values():
        return  # changed by a person: theirs is run
    if not full:
        grid = heel_grid(_COARSE_MM, heel.size)
        write_labels(target / f"{_COARSE}.nii.gz", labels_to_mesh(heel, labels_of(heel, grid)))
    write_whole(study, texts[full])


def _text(seed: int, full: bool) -> str:
    """The study file of one size."""
    loads = "".join(_LOAD.format(name=load.name, normal_n=load.normal_n, shear_n=load.shear_n or 0.0) for load in LOADS)
    return _STUDY.format(
        seed=seed, loads=loads, edge_mm=2.8 if full else 4.0, to_mesh="tissues_to_mesh" if full else _COARSE,
        sets=json.dumps(_ALL_SETS if full else _SETS), limit=_LIMIT if full else "",
    )  # fmt: skip


def _errors(
    target: Path, seed: int, ran: Ran, known: dict[str, tuple[TissueError, ...]]
) -> dict[str, tuple[TissueError, ...]]:
    """Error of each load by tissue, where its result is valid; those that are known are not computed again."""
    labels = read_labels(target / "tissues.nii.gz", target / "tissues.csv")
    heel = Heel(seed)
    errors = {}
    for load in ran.study.loads:
        folder = ran.study.out / REGISTRATION / load
        if load in known:
            errors[load] = known[load]
            continue
        if ran.outcomes[f"register {load}"].record is None:
            continue
        found = spline_in(folder)
        valid = read_mask(folder / VALID).inside
        errors[load] = errors_by_tissue(labels, under_load(heel, load), found, valid)
    return errors


def _reached(outcome: Outcome) -> bool:
    """Whether a stage gave all that was asked of it, or all that its limit of time allowed."""
    timed_out = outcome.record is not None and outcome.record.given.timed_out and not outcome.reason
    return outcome.whole or timed_out


def _why(outcome: Outcome) -> str:
    """A stage that is not whole, and what is said of it."""
    partly = [] if outcome.record is None else [line for line in outcome.record.given.lines if "ONLY" in line]
    return f"{outcome.stage}: {outcome.words}. {outcome.reason or ' '.join(partly)}"


def _told(errors: dict[str, tuple[TissueError, ...]], ran: Ran) -> list[str]:
    fat = {load: e for load, of in errors.items() for e in of if e.tissue == "fat"}
    told = ", ".join(f"{load} {e.shear_rmse:.3f} of {e.true_p95:.2f}" for load, e in fat.items())
    verdicts = {
        name.removeprefix("register "): section.verdict.words
        for name, outcome in ran.outcomes.items()
        if outcome.record is not None
        for section in outcome.record.given.sections
        if name.startswith("register ") and section.verdict is not None
    }
    lines = [
        "Verdicts on the registrations: " + ", ".join(f"{load} {words.lower()}" for load, words in verdicts.items()),
        f"Error of the maximal shear in fat (root mean square, of the true 95th percentile): {told}",
    ]
    compared = ran.outcomes["compare"].record
    if compared is not None:
        lines += [line for line in compared.given.lines if line.startswith(("All loads", "Nearest over"))]
    lines += [_why(outcome) for outcome in ran.outcomes.values() if not outcome.whole]
    return [*lines, f"Report: {ran.study.out / REPORT}"]
