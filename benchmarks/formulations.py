"""Mixed tetrahedra side by side: error and time of stabilised P1, MINI and P2 on three problems at nu = 0.4999.

    .venv/bin/python -m benchmarks.formulations --out benchmarks/results/formulations.json [--heel fine.vtu coarse.vtu]

Cook's membrane in three dimensions (bending and shear), a block pressed between a fixed face and a taped plate, and
the heel under a plate (meshes that `mrstrain mesh` made of one label map, in the order in which they are to run). One
after the other in one process, on one thread; what is compiled is compiled beforehand. The reference is P2 on the
finest mesh of each problem.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from dvc import StrainField, TetMesh
from fe import LoadState, LoadStep, NeoHooke, Ogden, Plate, Problem, Tolerance, material_set, read_tet_mesh, solve
from fe.assembly import Assembler
from fe.elements import Model, element
from fe.linear import Solver
from fe.newton import Imposed, equilibrium
from fe.result import patch_volumes, volume_percentiles
from mrstrain.records.provenance import versions
from tests.blocks import block

ELEMENTS = ("P1", "MINI", "P2")
COOK_MU_MPA, COOK_TRACTION_MPA, COOK_THICK_MM = 0.1, 0.00625, 10.0


def cook(name: str, n: int) -> dict[str, Any]:
    """Deflection (mm) of the upper corner of Cook's membrane, clamped at the left, sheared at the right."""
    box = block((2 * n, 2 * n, max(2, n // 2)), (1.0, 1.0, 1.0))
    x, y, z = box.points_mm.T
    points = np.column_stack([48.0 * x, 44.0 * x + y * (44.0 - 28.0 * x), COOK_THICK_MM * z])
    mesh = TetMesh(points, box.cells, {"all": np.arange(len(box.cells))}, box.facets)
    law = NeoHooke.of(COOK_MU_MPA)
    model = Model.of(mesh, {"all": law}, element(name))
    nodes = model.space.nodes_mm
    left = np.flatnonzero(nodes[:, 0] < 1e-9)
    assembler = Assembler(model, (3 * left[:, None] + np.arange(3)).ravel(), {})
    solver = Solver(assembler.indptr, assembler.indices)
    force = _traction(model, mesh, COOK_TRACTION_MPA)
    state, began, iterations = np.zeros(model.unknowns), time.perf_counter(), 0
    for share in (0.25, 0.5, 0.75, 1.0):
        inside = assembler.equation >= 0
        outside = np.bincount(assembler.equation[inside], share * force[inside], assembler.size)
        found = equilibrium(assembler, solver, state, Imposed(outside), Tolerance(step_mm=1e-4))
        if found is None:
            return {"element": name, "n": n, "failed": share}
        state, iterations = found.state, iterations + found.iterations
    tip = int(np.argmin(np.linalg.norm(nodes[:, :2] - [48.0, 60.0], axis=1) + np.abs(nodes[:, 2] - COOK_THICK_MM / 2)))
    return {
        "element": name, "n": n, "unknowns": model.unknowns, "seconds": time.perf_counter() - began,
        "iterations": iterations, "tip_mm": float(state[3 * tip + 1]),
    }  # fmt: skip


def _traction(model: Model, mesh: TetMesh, traction_mpa: float) -> np.ndarray:
    """Nodal forces of a uniform traction along y on the face at the right, by unknown."""
    force = np.zeros(model.unknowns)
    corners = mesh.points_mm[mesh.facets["x1"]]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if model.element.name != "P2":
        np.add.at(force, 3 * mesh.facets["x1"] + 1, (traction_mpa * area / 3.0)[:, None])
        return force
    # a quadratic triangle carries a uniform traction at the middles of its edges alone
    middles = {tuple(np.round(p, 6)): n for n, p in enumerate(model.space.nodes_mm)}
    for face, size in zip(corners, area, strict=True):
        for i, j in ((0, 1), (1, 2), (0, 2)):
            force[3 * middles[tuple(np.round((face[i] + face[j]) / 2, 6))] + 1] += traction_mpa * size / 3.0
    return force


def pressed_block(name: str, n: int) -> dict[str, Any]:
    """A block of 20 x 20 x 10 mm of fat between bone and a taped plate under 10 N."""
    box = block((n, 2 * n, 2 * n), (10.0, 20.0, 20.0), wobble=0.1)
    mesh = TetMesh(
        box.points_mm,
        box.cells,
        {"fat": np.arange(len(box.cells))},
        {"bone": box.facets["x1"], "skin": box.facets["x0"]},
    )
    laws = {"fat": Ogden.from_ansys(0.0034, 6.2)}
    began = time.perf_counter()
    state = solve(Problem(mesh, laws, Plate([-1, 0, 0], [0, 1, 0]), [LoadStep("press", 10.0)], element=name))[-1]
    return {"element": name, "n": n, "seconds": time.perf_counter() - began} | _figures(mesh, state, "fat")


def heel(name: str, mesh: TetMesh, load: LoadStep) -> dict[str, Any]:
    """The heel under a plate, the proposed set."""
    laws, _ = material_set("trebbi").for_regions(mesh.regions)
    began = time.perf_counter()
    state = solve(Problem(mesh, laws, Plate([0, 0, -1], [0, -1, 0]), [load], element=name))[-1]
    return {"element": name, "load": load.name, "seconds": time.perf_counter() - began} | _figures(mesh, state, "fat")


def _figures(mesh: TetMesh, state: LoadState, region: str) -> dict[str, Any]:
    strain = StrainField.from_gradient(state.gradients)
    cells = mesh.regions[region]
    shear = volume_percentiles(strain.max_shear[cells], mesh.volumes_mm3[cells], (0.5, 0.9, 0.99))
    patches = np.abs(patch_volumes(mesh, strain.jacobian) - 1.0)[mesh.cells].mean(axis=1)
    order = np.argsort(patches)
    within = np.cumsum(mesh.volumes_mm3[order]) / mesh.volumes_mm3.sum()
    return {
        "cells": len(mesh.cells), "reached": state.reached, "travel_mm": float(state.plate_displacement_mm[0]),
        "shear_p50": shear[0], "shear_p90": shear[1], "shear_p99": shear[2],
        "patch_det_f_off_for_95_percent": float(patches[order][np.searchsorted(within, 0.95)]),
        "iterations": state.iterations,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--heel", type=Path, nargs="+", default=[])
    parser.add_argument("--load", nargs=3, default=("Load1", "140", "0"), metavar=("NAME", "NORMAL", "SHEAR"))
    parser.add_argument("--elements", nargs="+", default=ELEMENTS)
    parser.add_argument("--sizes", type=int, nargs="+", default=[2, 4, 8])
    given = parser.parse_args()
    for name in given.elements:
        cook(name, 1)  # compiles
    found: dict[str, Any] = {"versions": versions(), "cook": [], "block": [], "heel": []}

    def tell(problem: str, row: dict[str, Any]) -> None:
        found[problem].append(row)
        given.out.write_text(json.dumps(found, indent=1) + "\n")
        print(problem, row, flush=True)

    for n in given.sizes:
        for name in given.elements:
            tell("cook", cook(name, n))
            tell("block", pressed_block(name, n))
    load = LoadStep(given.load[0], float(given.load[1]), float(given.load[2]))
    for place in given.heel:
        for name in given.elements:
            tell("heel", heel(name, read_tet_mesh(place), load))


if __name__ == "__main__":
    main()
