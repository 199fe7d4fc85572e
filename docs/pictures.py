"""The pictures at the head of the pages, from results of the demonstration and of the tutorials' own tests.

    mrstrain demo --out DEMO
    python -m pytest tests/test_tutorials.py -o tmp_path_retention_policy=all --basetemp=TUTORIALS
    PYTHONPATH=. python docs/pictures.py DEMO TUTORIALS

Pictures of the benchmarks are made by benchmarks/plots.py, those of the gallery by its examples:

    mkdir -p out && cd out
    for example in ../docs/gallery/*.py; do ../.venv/bin/python "$example"; done
    mv *.webp ../docs/images/gallery
"""

import base64
import io
import re
import sys
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import dvc
import fe
import phantoms
from dvc.report.strokes import MARKED, write_strokes_page
from tests.browser import browser
from tests.dvc.report.test_strokes_in_a_browser import choose, draw, opened as opened_in

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH, HEIGHT = 900, 640  # pixels, at most

DEMO = {
    "measure": "registration/Load1/figures/strain.png",
    "simulate": "models/trebbi/slices.png",
    "mesh": "mesh/mesh.png",
    "study": "comparison/slices_by_load.png",
    "validate": "comparison/curves_by_load.png",
}
TUTORIALS = {
    "tutorial-register": "test_register0/results/Load1/figures/strain.png",
    "verdicts": "test_register0/results/Load1/figures/overlay.png",
    "tutorial-validate": "test_validate0/compared/Load1/slices.png",
    "tutorial-material": "test_material0/fit/fit.png",
    "tutorial-cohort": "test_cohort0/cohort/report.html",
    "other-codes": "test_validate0/compared/Load1/agreement.png",
    "python-validate": "test_validate_in_python0/compared/curves_by_load.png",
    "python-dvc": "test_dvc_in_python0/max_shear.png",
}


STROKES = [  # tissue, brush in mm, plane, and spots as shares of the slice's width and height
    ("bone", 2.0, "sagittal", (0.60, 0.47), (0.66, 0.46), (0.72, 0.47)),
    ("fat", 2.0, "sagittal", (0.55, 0.75), (0.62, 0.76), (0.68, 0.74)),
    ("fat", 2.0, "sagittal", (0.82, 0.68), (0.84, 0.62), (0.85, 0.56)),
    ("muscle", 2.0, "sagittal", (0.18, 0.66), (0.26, 0.67), (0.33, 0.68)),
    ("bone", 2.0, "coronal", (0.45, 0.45), (0.50, 0.47), (0.55, 0.46)),
    ("fat", 2.0, "coronal", (0.40, 0.75), (0.50, 0.765), (0.60, 0.75)),
    ("bone", 2.0, "axial", (0.46, 0.62), (0.50, 0.64), (0.54, 0.62)),
    ("skin", 1.0, "coronal", (0.47, 0.815), (0.50, 0.818), (0.53, 0.815)),
]


def save(name: str, picture: Image.Image, width: int = WIDTH) -> None:
    """As WebP, small enough to stand above the fold."""
    picture = picture.convert("RGB")
    picture.thumbnail((width, HEIGHT), Image.Resampling.LANCZOS)
    picture.save(IMAGES / f"{name}.webp", quality=80, method=6)


def opened(source: Path) -> Image.Image:
    """A picture file, or the first picture of a report."""
    if source.suffix == ".html":
        first = re.search(r"data:image/[a-z]+;base64,([^\"')]+)", source.read_text())
        assert first, source
        return Image.open(io.BytesIO(base64.b64decode(first[1])))
    return Image.open(source)


def drawn(figure: plt.Figure) -> Image.Image:
    """A figure of matplotlib as a picture."""
    file = io.BytesIO()
    figure.savefig(file, dpi=110)
    return Image.open(file)


def timeline(log: Path) -> plt.Figure:
    """The stages of a study over time."""
    ended = re.findall(r"^(\S+)Z (\w[^:]*): done after (\d+) s$", log.read_text(), re.M)
    ends = [datetime.fromisoformat(time).timestamp() for time, _, _ in ended]
    took = [float(seconds) for _, _, seconds in ended]
    starts = [end - seconds for end, seconds in zip(ends, took, strict=True)]
    figure, axes = plt.subplots(figsize=(9, 3))
    colours = {"mesh": "C3", "register": "C0", "simulate": "C1", "compare": "C2"}
    order = sorted(range(len(ended)), key=starts.__getitem__, reverse=True)
    for row, n in enumerate(order):
        axes.barh(row, took[n], left=starts[n] - min(starts), color=colours[ended[n][1].split()[0]])
    axes.set_yticks(range(len(order)), [ended[n][1] for n in order])
    axes.set(xlabel="time", xticks=[])
    return figure


def phantom_scans() -> plt.Figure:
    """A sagittal slice of the phantom heel, unloaded and under Load1, and its true strain."""
    heel, grid = phantoms.Heel(seed=1), phantoms.heel_grid(spacing_mm=0.8)
    motion = phantoms.under_load(heel, "Load1")
    middle = grid.part((slice(grid.shape[0] // 2, grid.shape[0] // 2 + 2), slice(None), slice(None)))
    tissue = phantoms.labels_of(heel, middle).labels > 0
    true = dvc.strain_maps(motion, dvc.Mask(middle, tissue)).max_shear
    scans = [phantoms.scan(heel, grid, moved, snr=25.0, number=n).values for n, moved in enumerate((None, motion))]
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.4))
    slices = [*(scan[grid.shape[0] // 2] for scan in scans), true[0]]
    for one, image, title in zip(axes, slices, ("unloaded", "Load1", "true max. shear"), strict=True):
        one.imshow(image.T, origin="lower", cmap="viridis" if title.startswith("true") else "gray")
        one.set_title(title)
        one.axis("off")
    return figure


def motions() -> plt.Figure:
    """A heel in three states: unloaded, loaded as it was scanned, and with its bone put back."""
    s, t = np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 9))
    unloaded = np.stack([30.0 * s, 12.0 * t], axis=-1)
    u = np.stack([3.0 * s * (1.0 - t**2), 3.5 * (1.0 - s**2 / 2.0) * (1.0 - t)], axis=-1)  # none at the bone, above
    angle = np.radians(8.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    bone = np.stack([np.cos(np.linspace(0.0, np.pi, 60)) * 30.0, 12.0 + 16.0 * np.sin(np.linspace(0.0, np.pi, 60))], -1)

    def moved(points: np.ndarray) -> np.ndarray:
        return points @ turn.T + (4.0, 5.0)

    states = {
        "unloaded: X": (unloaded, bone),
        "loaded, as scanned: T(X) = T$_b$(X + u)": (moved(unloaded + u), moved(bone)),
        "bone put back: X + u(X)": (unloaded + u, bone),
    }
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.9), sharex=True, sharey=True)
    for one, (title, (tissue, bone_there)) in zip(axes, states.items(), strict=True):
        one.fill(*bone_there.T, color="#d9dee4", edgecolor="#4f5b69")
        lines = *np.moveaxis(tissue, -1, 0), *np.moveaxis(tissue.transpose(1, 0, 2), -1, 0)
        one.plot(*lines, color="C1", linestyle="-", linewidth=0.8)
        one.plot(*tissue[2, 4], "o", color="C0")
        one.set(title=title, aspect="equal")
        one.axis("off")
    axes[1].fill(*bone.T, facecolor="none", edgecolor="#4f5b69", linestyle=":")
    axes[2].annotate(
        "", unloaded[2, 4] + u[2, 4], unloaded[2, 4], arrowprops={"arrowstyle": "->", "color": "C0"}
    )  # fmt: skip
    axes[2].text(*(unloaded[2, 4] + (1.5, -1.0)), "u", color="C0")
    axes[0].text(0.0, 18.0, "bone", ha="center")
    return figure


def strokes(image: Path) -> Image.Image:
    """The page to draw on, with strokes in four tissues of the demonstration's heel."""
    numbers = {tissue: number for number, tissue in MARKED.items()}
    with TemporaryDirectory() as folder, browser() as tab:
        page = Path(folder) / "strokes.html"
        write_strokes_page(page, image.name, dvc.read_image(image))
        opened_in(tab, page)
        for tissue, brush_mm, plane, *spots in STROKES:
            choose(tab, numbers[tissue], brush_mm)
            draw(tab, plane, *spots)
        tab.value("window.scrollTo(0, 0)")
        shown = tab.call("Page.captureScreenshot", format="png")["data"]
    return Image.open(io.BytesIO(base64.b64decode(shown))).crop((0, 0, 1400, 860))


def bed() -> plt.Figure:
    """Tissue on a flat bone on a plate behind it, pressed and pulled upward, as over a sacrum."""
    values = dvc.Grid((16, 9, 16), (2.5, 2.5, 2.5), (0.0, 0.0, 0.0))
    labels = 0 * values.points()[..., 0].astype(int) + 1  # fat
    labels[:, -1], labels[:, :2] = 2, 3  # skin behind, bone in front
    mesh, _ = fe.mesh_labels(dvc.LabelMap(values, labels, {1: "fat", 2: "skin", 3: "bone"}), edge_mm=3.5)
    plate = fe.Plate(normal=(0, 1, 0), shear=(0, 0, 1))
    loads = [fe.LoadStep("supine", normal_n=12.0), fe.LoadStep("sliding down", normal_n=12.0, shear_n=5.0)]
    return fe.simulate(mesh, "trebbi", plate, loads).plot()


def main() -> None:
    """All of them."""
    demo, tutorials = map(Path, sys.argv[1:])
    plt.style.use(dvc.FIGURE_STYLE)
    for name, path in DEMO.items():
        save(name, opened(demo / "results" / path))
    save("strain", opened(demo / "results" / DEMO["study"]), 1200)
    for name, path in TUTORIALS.items():
        save(name, opened(tutorials / path))
    save("cluster", drawn(timeline(demo / "results" / "study.log")))
    save("phantoms", drawn(phantom_scans()))
    save("other-sites", drawn(bed()))
    save("theory", drawn(motions()))
    save("strokes", strokes(demo / "Load0.nii.gz"))


if __name__ == "__main__":
    main()
