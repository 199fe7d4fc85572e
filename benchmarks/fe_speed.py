"""Time and memory of one lift of the sole, beside CalculiX and FEBio, one thread each.

    .venv/bin/python -m benchmarks.fe_speed heel.vtu --out benchmarks/results/fe_speed.json

All have the same mesh, laws and supports: bone is fixed, and the skin nearest to the plate is lifted by 1.5 mm.
Programs run one after the other, each in a process of its own; what is compiled is compiled beforehand. Uses `ccx`
(Debian: calculix-ccx) and `febio4` where they are installed; FEBio 4 can be built from its source with MKL
(-DUSE_MKL=ON, and `#include <cstring>` in FECore/FSPath.cpp).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from dvc import TetMesh
from dvc.arrays import IntArray
from fe import (
    LoadState,
    LoadStep,
    PlateState,
    Tolerance,
    material_set,
    read_tet_mesh,
    write_calculix,
    write_febio,
)
from fe.assembly import Assembler
from fe.elements import Model, edges_of, element
from fe.linear import Solver
from fe.materials import Materials
from fe.newton import Imposed, equilibrium
from mrstrain.records.provenance import versions

LIFT_MM = 1.5
AREA_MM2 = 1500.0  # of the sole that is lifted, about


def lifted(mesh: TetMesh) -> tuple[IntArray, float]:
    """Nodes of the skin nearest to the plate, and the height that holds so much of the skin."""
    faces = mesh.facets["skin"]
    corners = mesh.points_mm[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    height = corners[:, :, 2].max(axis=1)
    order = np.argsort(height)
    level = height[order][np.searchsorted(np.cumsum(area[order]), AREA_MM2)]
    nodes = np.unique(faces)
    return nodes[mesh.points_mm[nodes, 2] <= level], float(level)


def ours(place: Path, name: str) -> dict[str, Any]:
    """Our solver in this process: displacement-controlled, as the decks are."""
    mesh = read_tet_mesh(place)
    laws, _ = material_set("trebbi").for_regions(mesh.regions)
    nodes, _ = lifted(mesh)
    began = time.perf_counter()
    model = Model.of(mesh, laws, element(name))
    bone = np.unique(mesh.facets["bone"])
    if name == "P2":
        for facets, kind in ((mesh.facets["bone"], "bone"), (mesh.facets["skin"], "skin")):
            ends = edges_of(facets)
            on = np.isin(ends, nodes).all(axis=1) if kind == "skin" else np.ones(len(ends), dtype=bool)
            middles = model.space.middles(ends[on])
            bone, nodes = (np.union1d(bone, middles), nodes) if kind == "bone" else (bone, np.union1d(nodes, middles))
    fixed = np.concatenate([(3 * bone[:, None] + np.arange(3)).ravel(), 3 * nodes, 3 * nodes + 1])
    assembler = Assembler(model, fixed, {0: 3 * nodes + 2})
    assembler.share({0: 3 * nodes + 2})
    solver = Solver(assembler.indptr, assembler.indices)
    found = equilibrium(
        assembler, solver, np.zeros(model.unknowns),
        Imposed(np.zeros(assembler.size), np.array([assembler.own_equations]), np.array([LIFT_MM])), Tolerance(),
    )  # fmt: skip
    assert found is not None
    return {
        "seconds": time.perf_counter() - began, "force_n": float(found.forces[3 * nodes + 2].sum()),
        "iterations": found.iterations, "factorisations": solver.factorisations,
    }  # fmt: skip


def problem(place: Path) -> tuple[TetMesh, Materials, LoadState]:
    """Mesh, laws and the lift as a state that decks can be written of."""
    mesh = read_tet_mesh(place)
    laws, _ = material_set("trebbi").for_regions(mesh.regions)
    nodes, _ = lifted(mesh)
    u = np.zeros_like(mesh.points_mm)
    u[nodes, 2] = LIFT_MM
    cells = len(mesh.cells)
    still = PlateState(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
    state = LoadState(LoadStep("lift", 1.0), 1.0, u, np.zeros(cells), np.zeros((cells, 3, 3)), nodes, (still,), 0, 0.0)
    return mesh, laws, state


def febio(place: Path, quadratic: bool, limit_s: float) -> dict[str, Any]:
    """FEBio on our deck in four steps, which it solves in half the time of one (or of full Newton in either)."""
    mesh, laws, state = problem(place)
    forces = '<logfile><node_data data="Rx;Ry;Rz" node_set="plate" file="force.txt" /></logfile>'
    with tempfile.TemporaryDirectory() as folder:
        deck = Path(folder) / "lift.feb"
        write_febio(deck, mesh, laws, state, quadratic=quadratic)
        told = deck.read_text()
        for usual, here in (
            ("<time_steps>20<", "<time_steps>4<"), ("<step_size>0.05<", "<step_size>0.25<"),
            ("<dtmax>0.1<", "<dtmax>0.25<"), ("<opt_iter>12<", "<opt_iter>20<"),
            ("</plotfile>", f"</plotfile>{forces}"),
        ):  # fmt: skip
            assert usual in told
            told = told.replace(usual, here)
        deck.write_text(told)
        one_thread = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        began = time.perf_counter()
        try:
            done = subprocess.run(
                ["febio4", "-i", "lift.feb"], cwd=folder, capture_output=True, text=True, timeout=limit_s,
                env=one_thread, check=True,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"seconds": None, "given_up_after_s": limit_s}
        seconds = time.perf_counter() - began
        last = (Path(folder) / "force.txt").read_text().split("*Step")[-1].splitlines()
    force = sum(float(line.split()[3]) for line in last if line[:1].isdigit())
    iterations = re.findall(r"Total number of equilibrium iterations[ .]*: (\d+)", done.stdout)
    return {"seconds": seconds, "force_n": abs(force), "iterations": int(iterations[-1])}


def calculix(place: Path, quadratic: bool, limit_s: float) -> dict[str, Any]:
    """CalculiX on our deck."""
    mesh, laws, state = problem(place)
    with tempfile.TemporaryDirectory() as folder:
        deck = Path(folder) / "lift.inp"
        write_calculix(deck, mesh, laws, state, quadratic=quadratic)
        deck.write_text(deck.read_text().replace("0.1, 1., 1e-5, 0.25", "1., 1., 1e-5, 1."))
        began = time.perf_counter()
        try:
            done = subprocess.run(
                ["ccx", "lift"], cwd=folder, capture_output=True, text=True, timeout=limit_s,
                env=os.environ | {"OMP_NUM_THREADS": "1"}, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"seconds": None, "given_up_after_s": limit_s}
        seconds = time.perf_counter() - began
        lines = (Path(folder) / "lift.dat").read_text().splitlines()
        at = max(n for n, line in enumerate(lines) if "total force" in line)
        force = [float(v) for v in lines[at + 2].split()[-3:]]
    return {"seconds": seconds, "force_n": force[2], "iterations": done.stdout.count(" iteration ")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--limit", type=float, default=1200.0, help="seconds for one run of another program")
    parser.add_argument("--one", help="run one program here and print its figures")
    given = parser.parse_args()
    if given.one:
        if given.one.startswith("P"):
            ours(given.mesh, given.one)  # compiles
            found = ours(given.mesh, given.one)
        elif given.one.startswith("C3D"):
            found = calculix(given.mesh, given.one == "C3D10", given.limit)
        else:
            found = febio(given.mesh, given.one == "tet10", given.limit)
        who = resource.RUSAGE_SELF if given.one.startswith("P") else resource.RUSAGE_CHILDREN
        print(json.dumps(found | {"peak_gib": resource.getrusage(who).ru_maxrss / 2**20}))
        return
    mesh = read_tet_mesh(given.mesh)
    nodes, _ = lifted(mesh)
    results: dict[str, Any] = {
        "versions": versions(), "cells": len(mesh.cells), "nodes": len(mesh.points_mm), "lifted": len(nodes),
        "runs": [],
    }  # fmt: skip
    febio_too, calculix_too = shutil.which("febio4") is not None, shutil.which("ccx") is not None
    linear = ["P1", *["tet4"] * febio_too, *["C3D4"] * calculix_too]
    quadratic = [*["tet10"] * febio_too, *["C3D10"] * calculix_too]
    for number in range(given.rounds):
        for name in [*linear, *quadratic] if number == 0 else linear:
            argv = [sys.executable, "-m", "benchmarks.fe_speed", str(given.mesh), "--one", name]
            said = subprocess.run([*argv, "--limit", str(given.limit)], capture_output=True, text=True, check=True)
            results["runs"].append({"program": name} | json.loads(said.stdout.splitlines()[-1]))
            print(results["runs"][-1], flush=True)
    if given.out:
        given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
