"""Tried beside splines with borders: displacements on tetrahedra that conform to the tissues, held by equilibrium.

    python -m benchmarks.tetrahedral_dvc HIDDEN --out benchmarks/results/tetrahedral_dvc.json

HIDDEN is the work folder of `benchmarks.hidden_law` after its run: a heel whose loaded images come from finite elements
with fat of three stiffnesses; the mesh is the study's own. Displacements are linear in each cell (global digital volume
correlation), zero at the bone, and begin at the splines with borders. Steps are halved while they raise what is
minimised,

    1/(2 s^2) sum r^2  +  v/8 sum_n V_n (J_n - 1)^2  +  w/2 sum_n |f_n / d_n|^2,

with r, s, v and the gradient of the fixed image as in the engine; V_n and J_n the volume of the cells around a node,
and its change; f_n the force that an elastic body (neo-Hooke, nu .45) of this deformation has at a node that nothing
loads, and d_n the node's own stiffness at the start: the gap of equilibrium (as Leclerc, Perie, Hild, Roux 2012,
doi:10.1051/meca/2012025, for small strain). Stiffnesses are those of the published set `trebbi`; once, all but fat's
are three times as high. Every weight w is told beside its error, so the best is known with the truth's help. Strain is
that of the cells, and that of nodes, averaged within each tissue. The true displacement at the nodes tells what the
mesh itself cannot hold; nodes beyond the truth's own mesh, all of them skin's, take the splines' there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numba import njit
from pypardiso import PyPardisoSolver
from scipy import sparse
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from benchmarks.nodal import at_corners, located
from dvc import AlignedPair, Deformation, Settings, StrainField, TetMesh, read_image, read_labels, register
from dvc.registration.gauss_newton.fit import brightness_scaled
from dvc.registration.gauss_newton.with_interfaces import fit_with_interfaces
from fe import NeoHooke, material_set, read_tet_mesh
from mrstrain.records.provenance import versions
from phantoms import distances_mm
from validate import read_result

GAIN_MM, VOLUME, NU = 10.0, 300.0, 0.45
STEPS, LONGEST_MM, HALVINGS = 12, 1.5, 4
STOP_MM = 0.005  # a step that moves nodes by less, root mean square, is the last
FLAT = 0.2  # det F of cells that are folded, or nearly: without elastic force, whose energy has no value there
FLATTEST = 0.1  # det F below this is taken as this in F^-T, as in the engine
SMALLEST = 1e-3


class Here:
    """Runs in this process what a worker would, and keeps what the engine was given and found."""

    def run(self, what, function, *given, watch=None):
        found = function(*given)
        if function is fit_with_interfaces:
            self.pair, self.found = given[0], found[0]
        return found


@njit(cache=True)
def image_sums(cells, weights, g, r, count):
    """Of each cell the sums of N_a N_b g g^T (m, 4, 4, 3, 3) and of N_a r g (m, 4, 3) over its voxels."""
    matrix, force = np.zeros((count, 4, 4, 3, 3)), np.zeros((count, 4, 3))
    for n in range(len(cells)):
        for a in range(4):
            for i in range(3):
                force[cells[n], a, i] += weights[n, a] * r[n] * g[n, i]
                for b in range(4):
                    for j in range(3):
                        matrix[cells[n], a, b, i, j] += weights[n, a] * weights[n, b] * g[n, i] * g[n, j]
    return matrix, force


def positive_solved(A, b):
    """x of A x = b, A symmetric."""
    solver, upper = PyPardisoSolver(mtype=-2), sparse.triu(A, format="csr")
    upper.sort_indices()
    x = solver.solve(upper, b)
    solver.free_memory(everything=True)
    return x


class Correlation:
    """Images as the engine was given them, the mesh, and the elastic body."""

    def __init__(self, mesh: TetMesh, pair: AlignedPair, stiffness_mpa: dict[str, float]) -> None:
        fixed, self.moving = brightness_scaled(pair)
        self.filtered = spline_filter(np.nan_to_num(self.moving.values), order=3, mode="mirror")
        self.mesh, self.nodes, self.grid = mesh, len(mesh.points_mm), fixed.grid
        points = fixed.grid.points(pair.compared.inside)
        cell, weights = located(mesh, points)
        kept = cell >= 0
        self.voxels = tuple(np.argwhere(pair.compared.inside)[kept].T)
        self.points, self.cell, self.weights = points[kept], cell[kept], weights[kept]
        values = fixed.values.astype(np.float64)
        slope = np.stack(np.gradient(values, *fixed.grid.spacing_mm), axis=-1)
        self.values, self.slope = values[self.voxels], slope[self.voxels] @ fixed.grid.direction.T
        corners = mesh.points_mm[mesh.cells]
        inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        self.slopes = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # (m, 4, 3)
        self.volumes, self.law, self.stiffness = mesh.volumes_mm3, NeoHooke.of(1.0, nu=NU), np.empty(len(mesh.cells))
        for name, cells in mesh.regions.items():
            self.stiffness[cells] = stiffness_mpa[name]
        free = np.ones(self.nodes, dtype=bool)
        free[mesh.facets["bone"]] = False
        self.free = np.repeat(free, 3)
        free[np.concatenate([mesh.facets["skin"], mesh.facets["cut"]])] = False  # unknown forces act there
        self.balanced = np.repeat(free, 3).astype(np.float64)
        self.patch = np.bincount(mesh.cells.ravel(), np.repeat(self.volumes, 4), minlength=self.nodes)

    def F(self, u):
        """Deformation gradient of each cell."""
        return np.eye(3) + np.einsum("mai,maj->mij", u[self.mesh.cells], self.slopes)

    def images(self, u, variance=None):
        """Hessian and force of the images at a displacement, their energy, and the residual's variance.

        All but the last are over a variance; that of the residual itself where none is given.
        """
        x = self.points + np.einsum("na,nai->ni", self.weights, u[self.mesh.cells[self.cell]])
        index = self.moving.grid.indices_of(x)
        seen = ((index >= 0) & (index <= np.array(self.moving.grid.shape) - 1)).all(axis=1)
        carried = map_coordinates(self.filtered, index.T, order=3, prefilter=False, mode="mirror")
        both, own = np.zeros(self.grid.shape), np.zeros(self.grid.shape)
        both[self.voxels], own[self.voxels] = seen * self.values * carried, seen * self.values**2
        sigma = GAIN_MM / self.grid.spacing_mm
        smooth = gaussian_filter(own, sigma, mode="constant")
        gain = (gaussian_filter(both, sigma, mode="constant") / np.maximum(smooth, 1e-9 * smooth.max()))[self.voxels]
        r = np.where(seen, gain * self.values - carried, 0.0)
        F = self.F(u)
        J = np.linalg.det(F)
        pulled = (np.linalg.inv(F) * (J / np.maximum(J, FLATTEST))[:, None, None])[self.cell]
        g = (seen * gain)[:, None] * np.einsum("nji,nj->ni", pulled, self.slope)
        matrix, force = image_sums(self.cell, self.weights, g, r, len(self.mesh.cells))
        own = float((r[seen] ** 2).mean())
        over = own if variance is None else variance
        energy = 0.5 * len(r) * own / over  # by the mean, so that voxels that leave the picture do not lower it
        return self._assembled(matrix) / over, self._summed(force) / over, energy, own

    def elastic(self, u):
        """Forces of the elastic body at its nodes, and their derivative."""
        F = self.F(u)
        F[np.linalg.det(F) < FLAT] = np.eye(3)
        weight = self.volumes * self.stiffness
        forces = np.einsum("m,mij,maj->mai", weight, self.law.stress(F), self.slopes)
        tangent = np.einsum(
            "m,maJ,miJkL,mbL->mabik", weight, self.slopes, self.law.tangent(F), self.slopes, optimize=True
        )
        return self._summed(forces), self._assembled(tangent)

    def swelling(self, u):
        """J - 1 of the cells around each node, and its derivative."""
        F, cells = self.F(u), self.mesh.cells
        J = np.linalg.det(F)
        slope = np.einsum("m,mji,maj->mai", self.volumes * J, np.linalg.inv(F), self.slopes)
        shape = (len(cells), 4, 4, 3)
        rows, columns = cells[:, :, None, None], 3 * cells[:, None, :, None] + np.arange(3)
        entries = [np.broadcast_to(v, shape).ravel() for v in (slope[:, None], rows, columns)]
        B = sparse.csr_matrix((entries[0], tuple(entries[1:])), shape=(self.nodes, 3 * self.nodes))
        swollen = np.bincount(cells.ravel(), np.repeat(self.volumes * J, 4), minlength=self.nodes)
        return swollen / self.patch - 1.0, sparse.diags(1.0 / self.patch) @ B

    def solved(self, u, weight):
        """Gauss-Newton steps from a displacement, halved while they raise the energy; and how they ended."""
        per_volume = sparse.diags(VOLUME * self.patch / 4.0)
        per_node = sparse.diags(self.balanced / np.maximum(self.elastic(u)[1].diagonal(), 1e-30))

        def state(u, variance=None):
            H, force, energy, own = self.images(u, variance)
            f, K = self.elastic(u)
            gap, G = per_node @ f, per_node @ K
            J, B = self.swelling(u)
            energy += 0.5 * weight * gap @ gap + 0.5 * J @ (per_volume @ J)
            return H, force, gap, G, J, B, energy, own

        for taken in range(1, STEPS + 1):  # noqa: B007 (told)
            H, force, gap, G, J, B, before, variance = state(u)
            A = H + weight * (G.T @ G) + B.T @ per_volume @ B + SMALLEST * sparse.eye(3 * self.nodes)
            b = force - weight * (G.T @ gap) - B.T @ (per_volume @ J)
            step = np.zeros(3 * self.nodes)
            step[self.free] = positive_solved(A.tocsr()[self.free][:, self.free], b[self.free])
            step = step.reshape(-1, 3)
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, LONGEST_MM / np.maximum(length, 1e-12))[:, None]  # node by node
            for _ in range(HALVINGS):
                if state(u + step, variance)[-2] <= before * (1.0 + 1e-3):
                    break
                step *= 0.5
            else:
                break
            u = u + step
            moved = float(np.sqrt((step**2).sum(axis=1).mean()))
            if moved < STOP_MM:
                break
        folded = int(np.count_nonzero(np.linalg.det(self.F(u)) <= 0.0))
        return u, {"steps": taken, "last_step_mm": round(moved, 4), "folded_cells": folded}

    def _summed(self, of_cells):
        out = np.zeros((self.nodes, 3))
        np.add.at(out, self.mesh.cells, of_cells)
        return out.ravel()

    def _assembled(self, blocks):
        cells, zero = self.mesh.cells, np.zeros(blocks.shape, dtype=np.int64)
        rows = 3 * cells[:, :, None, None, None] + np.arange(3)[:, None] + zero
        columns = 3 * cells[:, None, :, None, None] + np.arange(3) + zero
        size = 3 * self.nodes
        return sparse.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))


class Truth:
    """The hidden model at the voxels that both it and the mesh hold, and errors against it."""

    def __init__(self, labels, mesh: TetMesh, true: Deformation) -> None:
        inside = labels.labels > 0
        X = labels.grid.points(inside)
        cell, weights = located(mesh, X)
        u, H = true.evaluate(X)
        kept = (cell >= 0) & np.isfinite(u).all(axis=1)
        self.X, self.cell, self.weights, self.u = X[kept], cell[kept], weights[kept], u[kept]
        self.shear = StrainField.from_gradient(H[kept]).max_shear
        tissue, near = labels.labels[inside][kept], distances_mm(labels)[0][inside][kept] < 3.0
        named = {name: tissue == number for number, name in labels.names.items()}
        self.places = {name: named[name] for name in ("fat", "muscle", "skin")} | {"fat near bone": named["fat"] & near}

    def errors(self, u, H):
        """Of displacement (n, 3) and gradient (n, 3, 3) at its points."""
        error = StrainField.from_gradient(H).max_shear - self.shear
        distance = np.linalg.norm(u - self.u, axis=1)
        return {
            name: {
                "shear_rmse": round(float(np.sqrt(np.mean(error[where] ** 2))), 4),
                "shear_bias": round(float(error[where].mean()), 4),
                "u_p50_mm": round(float(np.median(distance[where])), 4),
                "u_p95_mm": round(float(np.percentile(distance[where], 95)), 4),
            }
            for name, where in self.places.items()
        }

    def fat_by_edge(self, problem: Correlation, u):
        """Error of the shear of cells in fat by their mean edge, mm, and the share of fat's volume in them."""
        corners = problem.mesh.points_mm[problem.mesh.cells]
        edges = [np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i in range(4) for j in range(i)]
        edge = np.mean(edges, axis=0)[self.cell]
        shear = StrainField.from_gradient(problem.F(u) - np.eye(3)).max_shear[self.cell]
        rows, fat = {"mean": round(float(edge[self.places["fat"]].mean()), 2)}, self.places["fat"]
        for low, high in ((1.5, 2.0), (2.0, 2.5), (2.5, 3.0), (3.0, 4.0), (4.0, 5.0)):
            there = fat & (edge >= low) & (edge < high)
            error = float(np.sqrt(np.mean((shear - self.shear)[there] ** 2)))
            rows[f"{low} to {high} mm"] = [round(error, 4), round(float(there.sum() / fat.sum()), 3)]
        return rows

    def both_errors(self, problem: Correlation, u):
        """By the strain of cells, and by that of nodes."""
        H = problem.F(u) - np.eye(3)
        moved = np.einsum("na,nai->ni", self.weights, u[problem.mesh.cells[self.cell]])
        smooth = np.einsum("na,naij->nij", self.weights, at_corners(problem.mesh, H)[self.cell])
        return {"cells": self.errors(moved, H[self.cell]), "nodes": self.errors(moved, smooth)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hidden", type=Path)
    parser.add_argument("--load", default="Load1")
    parser.add_argument("--weights", type=float, nargs="+", default=[10.0, 100.0, 1000.0, 10000.0])
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    study = given.hidden / "study"
    labels = read_labels(study / "tissues.nii.gz", study / "tissues.csv")
    worker = Here()
    register(
        read_image(study / "Load0.nii.gz"), read_image(study / f"{given.load}.nii.gz"), bone=labels.region("bone"),
        labels=labels, settings=Settings.of("gauss-newton-borders"), worker=worker,
    )  # fmt: skip
    mesh = read_tet_mesh(study / "results" / "mesh" / "mesh.vtu")
    true = read_result("hidden", given.hidden / "simulated" / "hidden" / f"{given.load}.vtu").deformation
    truth = Truth(labels, mesh, true)
    start = worker.found.displacement(mesh.points_mm)
    start[mesh.facets["bone"]] = 0.0
    exact = true.displacement(mesh.points_mm)
    laws, _ = material_set("trebbi").for_regions(mesh.regions)
    rows: list[dict[str, object]] = [{"way": "splines with borders", **truth.errors(*worker.found.evaluate(truth.X))}]

    def tell(way: str, weight: float | None, found) -> None:
        rows.append({"way": way, "weight": weight, **found})
        told = {"versions": versions(), "load": given.load, "cells": len(mesh.cells), "rows": rows}
        given.out.write_text(json.dumps(told, indent=1) + "\n")
        print(json.dumps(rows[-1]), flush=True)

    for factor in (1.0, 3.0):
        stiffness = {n: law.shear_modulus_mpa * (1.0 if n == "fat" else factor) for n, law in laws.items()}
        problem = Correlation(mesh, worker.pair, stiffness)
        if factor == 1.0:
            told = truth.both_errors(problem, np.where(np.isfinite(exact), exact, start))
            told["taken_from_the_start"] = int(np.count_nonzero(~np.isfinite(exact).all(axis=1)))
            told["fat_by_edge"] = truth.fat_by_edge(problem, np.where(np.isfinite(exact), exact, start))
            tell("the true displacement at the nodes", None, told)
        for weight in given.weights:
            way = "tetrahedra" if factor == 1.0 else "tetrahedra, all but fat three times as stiff"
            u, ended = problem.solved(start, weight)
            tell(way, weight, truth.both_errors(problem, u) | ended)


if __name__ == "__main__":
    main()
