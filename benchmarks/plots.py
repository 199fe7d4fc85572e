"""The plots of docs/benchmarks/README.md and docs/engines.md, from the result files alone.

    .venv/bin/python -m benchmarks.plots

Writes docs/images/benchmarks/*.webp. Nothing is measured here: run it again when a file in `results/` has changed.
"""

from __future__ import annotations

import json
from pathlib import Path
from statistics import mean, median
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import dvc
from benchmarks.accuracy_tables import BONE_MASKS, CONDITIONS, LABEL_MAPS, USUAL, Results

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
IMAGES = HERE.parent / "docs" / "images" / "benchmarks"
TISSUES = ("fat", "muscle", "skin", "bone")
plt.style.use(dvc.FIGURE_STYLE)
OURS, ELASTIX, LABELS, ONE_SPLINE = plt.rcParams["axes.prop_cycle"].by_key()["color"][:4]
OTHERS = "#7d8894"
MARKERS = {OURS: "o-", ELASTIX: "^-", LABELS: "s-", ONE_SPLINE: "D-"}
ENGINES = {
    "gauss-newton-bone": ("bone mask alone", OURS),
    "gauss-newton-borders": ("with a label map", LABELS),
    "gauss-newton": ("one smooth spline", ONE_SPLINE),
    "heel-mr": ("elastix (heel-mr)", ELASTIX),
}
PEERS = {
    "gauss-newton-bone": "mrstrain", "gauss-newton-borders": "mrstrain with a label map",
    "heel-mr": "mrstrain with elastix", "elastix default, as acquired": "elastix, defaults",
}  # fmt: skip
SETS = ("trebbi", "zwam", "erdemir", "akrami", "luboz")
MOTIONS = {
    "trebbi": "material set trebbi", "akrami": "material set akrami", "stiff-skin": "stiff skin",
    "soft-skin": "soft skin", "stiff-fat": "stiff fat", "stiff-muscle": "stiff muscle", "lobules": "fat in lobules",
    "lobules at 1.2 mm": "the same, 1.2 mm", "slipping": "plate without tape", "loads": "Load3 (seen)",
    "sliding": "sliding fat pad (seen)",
}  # fmt: skip
SEEN = ("loads", "sliding")
"""Motions of the accuracy study itself; all others are of finite-element models."""


def read(name: str) -> Any:
    """A result file by its name."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def panels(count: int = 1, height: float = 3.2) -> tuple[Figure, list[Axes]]:
    """Plots side by side, without frames."""
    figure, axes = plt.subplots(1, count, figsize=(9, height), squeeze=False)
    for one in axes.flat:
        one.grid(axis="y")
    return figure, list(axes.flat)


def peers() -> Figure:
    """Error of every program by tissue, means of the held-out pairs."""
    runs = [run for run in read("peers")["runs"] if run["status"] == "done"]
    errors = {
        peer: [mean(run["tissues"][t]["shear_rmse"] for run in runs if run["peer"] == peer) for t in TISSUES]
        for peer in {run["peer"] for run in runs} - {"elastix default", "gauss-newton"}
    }
    figure, axes = panels(len(TISSUES), 3.6)
    order = sorted(errors, key=lambda peer: errors[peer][0], reverse=True)
    for column, (one, tissue) in enumerate(zip(axes, TISSUES, strict=True)):
        colours = [ENGINES[p][1] if p in ENGINES else OTHERS for p in order]
        bars = one.barh(range(len(order)), [errors[p][column] for p in order], color=colours)
        one.bar_label(bars, fmt="%.3f", padding=2, fontsize=7)
        one.grid(visible=False)
        one.set(title=tissue, xticks=[], xlim=(0, 1.25 * max(errors[p][column] for p in order)))
        one.set_yticks(range(len(order)), [PEERS.get(p, p) for p in order] if not column else [], fontsize=8)
    figure.supxlabel("root mean square error of the maximum shear strain", fontsize=9)
    return figure


def error() -> Figure:
    """Error in fat and skin over noise and voxel size."""
    figure, axes = panels(3)
    names = [f"{voxel} mm\nSNR {snr:g}" for voxel, snr in CONDITIONS]
    names[3] = "0.8, 0.8,\n1.6 mm"
    names[4] = "1.2 mm"
    for one, tissue in zip(axes, ("fat", "muscle", "skin"), strict=True):
        for engine in ("gauss-newton", "gauss-newton-borders", "heel-mr"):
            (label, colour), results = ENGINES[engine], Results(RESULTS / "accuracy" / engine)
            values = [results.error(tissue, condition=condition) for condition in CONDITIONS]
            one.plot(range(3), values[:3], MARKERS[colour], color=colour, label=label)
            one.plot((3, 4), values[3:], MARKERS[colour][0], color=colour)
        one.set(title=tissue, ylim=(0, 0.08))
        one.set_xticks(range(len(names)), names, fontsize=7)
    axes[0].set_ylabel("RMSE of the max. shear")
    axes[0].legend(fontsize=8)
    return figure


def engines() -> Figure:
    """Error of each engine under every motion: in fat, in fat beside bone, and in skin; masks are correct."""
    figure, axes = panels(3)
    motions = ("smooth", "sliding", "Load1", "Load3")
    shown: dict[str, tuple[str, float | None]] = {
        "fat": ("fat", None), "fat within 1.5 mm of bone": ("fat", 0.0), "skin": ("skin", None)
    }  # fmt: skip
    for one, (title, (tissue, to_bone_mm)) in zip(axes, shown.items(), strict=True):
        for place, (engine, (label, colour)) in enumerate(ENGINES.items()):
            folder = {"gauss-newton-borders": LABEL_MAPS, "gauss-newton-bone": BONE_MASKS}.get(engine, engine)
            off = None if folder == engine else 0
            results = Results(RESULTS / "accuracy" / folder)
            heights = [
                results.error(tissue, motions=(motion,), to_bone_mm=to_bone_mm, labels_off=off) for motion in motions
            ]
            one.bar(np.arange(len(motions)) + 0.21 * (place - 1.5), heights, 0.2, color=colour, label=label)
        one.set(title=title, ylim=(0, 0.1))
        one.set_xticks(range(len(motions)), motions, fontsize=8)
    axes[0].set_ylabel("RMSE of the max. shear")
    axes[0].legend(fontsize=8)
    return figure


def resolution() -> Figure:
    """How much of a sinusoidal shear is recovered over its wavelength."""
    figure, axes = panels(3)
    for one, tissue in zip(axes, ("fat", "muscle", "skin"), strict=True):
        for engine in ("gauss-newton", "heel-mr"):
            label, colour = ENGINES[engine]
            rows = sorted(
                (float(row["wavelength_mm"]), float(row["recovered"]))
                for row in Results(RESULTS / "accuracy" / engine).table("resolution.csv")
                if (row["voxel_mm"], float(row["snr"])) == USUAL and row["tissue"] == tissue
            )
            one.plot(*zip(*rows, strict=True), MARKERS[colour], color=colour, label=label)
        one.axhline(0.9, color="k", linewidth=0.6, linestyle=":")
        one.set(title=tissue, xlabel="wavelength, mm", ylim=(0, 1.1))
    axes[0].set_ylabel("fraction recovered")
    axes[2].legend(fontsize=8, loc="lower right")
    return figure


def coverage() -> Figure:
    """Voxels that the error bars cover, by tissue, motion and engine."""
    told = read("unforeseen")
    columns = {"fat": "fat", "muscle": "muscle", "skin": "skin", "near bone": "within 3 mm of bone"}
    engines = (("gauss-newton-borders", 0.2), ("gauss-newton-bone", 0.0), ("gauss-newton", -0.2))
    figure, axes = panels(len(columns), 3.6)
    rows = list(reversed(MOTIONS))
    seen = [place for place, motion in enumerate(rows) if motion in SEEN]
    for one, (column, title) in zip(axes, columns.items(), strict=True):
        one.axhspan(min(seen) - 0.5, max(seen) + 0.5, color=OTHERS, alpha=0.15, linewidth=0)
        one.axvline(95, color="k", linewidth=0.6, linestyle=":")
        for engine, up in engines:
            label, colour = ENGINES[engine]
            shares = [100.0 * told[engine].get(motion, {}).get(column, np.nan) for motion in rows]
            one.plot(shares, np.arange(len(rows)) + up, MARKERS[colour][0], color=colour, label=label, markersize=5)
        one.grid(visible=False)
        one.set(title=title, xlim=(78, 101), xticks=(80, 90, 95, 100))
        one.set_yticks(range(len(rows)), [MOTIONS[m] for m in rows] if column == "fat" else [], fontsize=8)
    axes[1].legend(fontsize=7, loc="upper left")
    figure.supxlabel("voxels whose true strain lies within 1.96 standard uncertainties, %", fontsize=9)
    return figure


def areas() -> Figure:
    """Area between strain-volume curves of a heel with a hidden model: true, and as a study estimates it."""
    told = read("hidden_law")
    figure, axes = panels(5, 3)
    for one, load in zip(axes, ("Load1", "Load2", "Load3", "Load4", "all loads"), strict=True):
        for place, name in enumerate(SETS):
            _, estimate, low, high = told["measured_area_ml"][load][name]
            one.plot((place, place), (low, high), color=OURS, linewidth=2, label=None if place else "95 %")
            one.plot(place, estimate, "_", color=OURS, markersize=12, label=None if place else "estimated")
            one.plot(place, told["true_area_ml"][load][name], "kx", label=None if place else "true")
        one.set_title(load)
        one.set_ylim(bottom=0)
        one.set_xticks(range(len(SETS)), SETS, rotation=45, fontsize=8)
    axes[0].set_ylabel("area, mL")
    axes[0].legend(fontsize=7)
    return figure


def registration() -> Figure:
    """Processor time and memory of `mrstrain register` over the number of voxels."""
    figure, axes = panels(2)
    kinds = {
        (False, None, False): ENGINES["gauss-newton-bone"], (True, None, False): ENGINES["gauss-newton-borders"],
        (False, None, True): ENGINES["gauss-newton"], (False, "heel-mr", False): ENGINES["heel-mr"],
    }  # fmt: skip
    runs = read("register_scaling")["runs"]
    for one, key, label in zip(axes, ("processor_s", "peak_gib"), ("processor time, s", "memory, GiB"), strict=True):
        for kind, (name, colour) in kinds.items():
            chosen = sorted(
                (run["voxels"] / 1e6, run[key])
                for run in runs
                if (run["labels"], run["preset"], run["one_spline"]) == kind
            )
            one.plot(*zip(*chosen, strict=True), MARKERS[colour], color=colour, label=name)
        one.set(xlabel="million voxels", ylabel=label, xlim=(0, None), ylim=(0, None))
    axes[0].legend(fontsize=8)
    return figure


def elements() -> Figure:
    """The solver: one displacement of the sole by FEBio and CalculiX too; time and memory over the number of cells."""
    figure, axes = panels(3)
    runs = read("fe_speed")["runs"]
    programs = {
        "P1": "mrstrain", "tet4": "FEBio\ntet4", "C3D4": "CalculiX\nC3D4", "tet10": "FEBio\ntet10",
        "C3D10": "CalculiX\nC3D10",
    }  # fmt: skip
    for place, program in enumerate(programs):
        seconds = [run["seconds"] for run in runs if run["program"] == program and run["seconds"]]
        given_up = [run["given_up_after_s"] for run in runs if run["program"] == program and not run["seconds"]]
        height = median(seconds) if seconds else given_up[0]
        bar = axes[0].bar(place, height, color=OURS if program == "P1" else OTHERS, hatch="" if seconds else "//")
        force = [run["force_n"] for run in runs if run["program"] == program and run["seconds"]]
        told = f"{height:.0f} s\n{force[0]:.0f} N" if seconds else "no result"
        axes[0].bar_label(bar, [told], fontsize=7)
    axes[0].set(ylabel="one prescribed displacement, s", ylim=(0, 80))
    axes[0].set_xticks(range(len(programs)), programs.values(), fontsize=6)
    scaling = read("fe_scaling")
    for one, key, label in zip(axes[1:], ("load_s", "peak_gib"), ("Load1, s", "memory, GiB"), strict=True):
        one.plot(np.array(scaling["cells"]) / 1000.0, scaling["least"][key], MARKERS[OURS], color=OURS)
        one.set(xlabel="thousand cells", ylabel=label, xlim=(0, None), ylim=(0, None))
    return figure


def convergence() -> Figure:
    """Fat's strain and the plate's displacement over the size of the cells, relative to their limits."""
    told = read("converge_heel")
    figure, (one,) = panels(1, 2.8)
    names = (
        "plate displacement",
        *(f"max. shear of fat, {p}" for p in ("median", "90th percentile", "99th percentile")),
    )
    for row, name in zip(told["rows"], names, strict=True):
        one.plot(told["sizes_mm"], 100.0 * (np.array(row["values"]) / row["limit"]["limit"] - 1.0), "o-", label=name)
    one.axhline(0.0, color="k", linewidth=0.6)
    one.set(xlabel="size of the cells, mm", ylabel="off the limit, %", xlim=(0, None))
    one.legend(fontsize=8)
    return figure


PLOTS = (peers, error, engines, resolution, coverage, areas, registration, elements, convergence)


def main() -> None:
    IMAGES.mkdir(parents=True, exist_ok=True)
    for plot in PLOTS:
        plot().savefig(IMAGES / f"{plot.__name__}.webp", dpi=110, pil_kwargs={"quality": 85, "method": 6})


if __name__ == "__main__":
    main()
