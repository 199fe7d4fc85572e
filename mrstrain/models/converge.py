"""`converge`: the same loads on meshes of several sizes, and what the figures tend to."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dvc.atomic_files import whole_file, write_json, write_whole
from dvc.errors import InputError, MrstrainError
from dvc.io.images.labels import read_labels
from fe import figures
from fe.convergence import Limit, extrapolated, size_mm
from fe.mesh_file import read_tet_mesh
from fe.published import material_set
from fe.simulate import LoadStep
from fe.surface_sets import BONE
from mrstrain.models.loads import LOADS
from mrstrain.models.mesh import mesh as make_mesh
from mrstrain.models.simulate import simulate
from mrstrain.records.inputs import make_output, refuse_touching_inputs
from mrstrain.records.provenance import file_hash, provenance

Told = Callable[[str, str, float], None]

_FEWEST = 3


@dataclass(frozen=True, slots=True)
class Row:
    """A figure of one load: its value on each mesh, and what it tends to."""

    load: str
    figure: str
    values: tuple[float, ...]
    limit: Limit


@dataclass(frozen=True, slots=True)
class Converged:
    """What `converge` gave."""

    out: Path
    sizes_mm: tuple[float, ...]
    rows: tuple[Row, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = ["Size of the cells, mm: " + ", ".join(f"{s:.2f}" for s in self.sizes_mm)]
        for row in self.rows:
            values = ", ".join(f"{v:.4g}" for v in row.values)
            limit, tends = row.limit, "no limit can be told"
            if np.isfinite(limit.limit):
                tends = f"tends to {limit.limit:.4g} (order {limit.order:.1f}), the finest is off by {limit.error:+.1%}"
            lines.append(f"{row.load}, {row.figure}: {values}; {tends}")
        return [*lines, f"Results: {self.out}"]


def converge(
    labels: Path | str,
    edges_mm: Sequence[float],
    *,
    out: Path | str,
    names: Path | str | None = None,
    bones: Sequence[str] = (BONE,),
    region: str = "fat",
    material: str = "trebbi",
    loads: Sequence[LoadStep] = LOADS,
    plate_normal: Sequence[float] = (0.0, 0.0, -1.0),
    shear_direction: Sequence[float] = (0.0, -1.0, 0.0),
    workers: int | None = None,
    progress: Told | None = None,
) -> Converged:
    """Mesh a label map with several edge lengths, simulate the same loads on each, and extrapolate.

    Parameters
    ----------
    labels, names, bones
        As in `mesh`.
    edges_mm : sequence of float
        Three edge lengths or more, mm.
    out : path
        Gets ``mesh-E.vtu`` and ``simulated-E`` for each edge length E, ``convergence.csv`` and ``convergence.png``. A
        mesh that is there already and was made from the same label map is used again.
    region : str
        Region whose maximal shear is followed.
    material, loads, plate_normal, shear_direction, workers, progress
        As in `simulate`, with one material set.

    Raises
    ------
    InputError
        If there are fewer than three edge lengths, or the region or the set does not fit; before anything is meshed.
    MrstrainError
        If a load is not reached on a mesh.
    """
    edges = sorted(set(edges_mm), reverse=True)
    if len(edges) < _FEWEST:
        raise InputError(f"A study of convergence needs {_FEWEST} edge lengths or more; got {len(edges)}.")
    target = Path(out)
    inputs = {"labels": Path(labels)} | ({} if names is None else {"names": Path(names)})
    refuse_touching_inputs(target, [f"simulated-{edge:g}" for edge in edges], list(inputs.values()))
    make_output(target)
    tell = progress or (lambda *_: None)
    known = list(read_labels(labels, names).names.values())
    if region not in known or region in bones:
        raise InputError(f"No soft tissue '{region}' in the label map to follow; it has {', '.join(known)}.")
    material_set(material).for_regions([name for name in known if name not in bones])  # before hours of meshing
    places = {edge: target / f"mesh-{edge:g}.vtu" for edge in edges}
    values = []
    for edge, place in places.items():
        if not _is_of(place, inputs, bones):
            make_mesh(
                labels, out=place, edge_mm=edge, names=names, bones=bones,
                watch=lambda share, edge=edge: tell(f"{edge:g} mm", "meshing", share),  # type: ignore[misc]
            )  # fmt: skip
    sizes = [size_mm(read_tet_mesh(place)) for place in places.values()]
    extrapolated(np.array(sizes), np.array(sizes))  # refuses sizes that tell nothing, before anything is simulated
    for edge, place in places.items():
        made = simulate(
            place, out=target / f"simulated-{edge:g}", sets=[material], loads=loads, plate_normal=plate_normal,
            shear_direction=shear_direction, workers=workers,
            progress=lambda case, stage, share, edge=edge: tell(f"{edge:g} mm, {case}", stage, share),  # type: ignore[misc]
        )  # fmt: skip
        if not made.complete:
            raise MrstrainError(
                f"With edges of {edge:g} mm not every load was reached: {' '.join(made.summary()[:-1])}"
            )
        found = {}
        for state in made.sets[0].states:
            found[state.load.name, "plate travel, mm"] = float(np.hypot(*state.travel_mm[:2]))
        for figure in made.sets[0].figures:
            if figure.region == region:
                for percent, value in ((50, figure.shear_p50), (90, figure.shear_p90), (99, figure.shear_p99)):
                    found[figure.load, f"maximal shear of {region}, p{percent}"] = value
        values.append(found)
    rows = tuple(
        Row(load, figure, tuple(v[load, figure] for v in values), _limit(sizes, [v[load, figure] for v in values]))
        for load, figure in values[0]
    )
    _write(target, sizes, edges, rows, provenance("converge", inputs, {"edges_mm": edges, "material": material}))
    return Converged(target, tuple(sizes), rows)


def _limit(sizes: Sequence[float], values: Sequence[float]) -> Limit:
    return extrapolated(np.array(sizes), np.array(values))


def _plain(row: dict[str, object]) -> dict[str, object]:
    """A row with None for what is not known, since JSON has no NaN."""
    limit = row["limit"]
    assert isinstance(limit, dict)
    return row | {"limit": {key: value if np.isfinite(value) else None for key, value in limit.items()}}


def _is_of(place: Path, inputs: dict[str, Path], bones: Sequence[str]) -> bool:
    """Whether a mesh is there and was made from these files as they are now, with the same bones cut out."""
    about = place.with_suffix(".json")
    if not (place.is_file() and about.is_file()):
        return False
    hashes = {role: [file_hash(path)] for role, path in inputs.items()}
    try:
        told = json.loads(about.read_text(encoding="utf-8"))
        known = {role: [f["sha256"] for f in files] for role, files in told["inputs"].items()}
        return bool(known == hashes and told["parameters"]["bones"] == list(bones))
    except (ValueError, KeyError, TypeError, AttributeError):  # not what `mesh` writes
        return False


def _write(
    target: Path, sizes: Sequence[float], edges: Sequence[float], rows: Sequence[Row], record: dict[str, object]
) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["load", "figure", *(f"edge_{e:g}_mm" for e in edges), "limit", "order", "scatter", "error_of_finest"]
    )
    for row in rows:
        numbers = (*row.values, row.limit.limit, row.limit.order, row.limit.scatter, row.limit.error)
        writer.writerow([row.load, row.figure, *(f"{v:.6g}" if np.isfinite(v) else "" for v in numbers)])
    write_whole(target / "convergence.csv", text.getvalue())
    curves = {f"{r.load}, {r.figure}": (r.values, r.limit) for r in rows if np.isfinite(r.limit.limit)}
    (target / "convergence.png").unlink(missing_ok=True)
    if curves:
        with whole_file(target / "convergence.png") as part:
            part.write_bytes(figures.convergence(sizes, curves))
    write_json(
        target / "convergence.json", {"sizes_mm": list(sizes), "rows": [_plain(asdict(r)) for r in rows]} | record
    )
