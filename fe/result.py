"""Results of a load: stress, volume, statistics by region; VTU files for ParaView and tables, written and read."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import chain
from pathlib import Path

import meshio
import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray
from dvc.atomic_files import whole_file, write_csv
from dvc.own_files import read_rows
from dvc.trust.regions import SHEAR_THRESHOLDS, volume_above
from fe.elements import CROWDED
from fe.load_path import PlateState
from fe.materials import Materials
from fe.published import doubts
from fe.solution import LoadState

_SHARES = (0.5, 0.9, 0.95, 0.99)
_FAR = 0.05  # difference of det F between a patch and the constitutive model, above which the volume is counted
PLATE_VECTORS = ("displacement_mm", "force_n", "turn_deg", "moment_nmm")
"""Vectors of a plate's state."""
BEFORE = "travel", "displacement"
"""What the first was called in older files, and is called now."""
_COLUMNS = {
    vector: [vector.replace("_", f"_{axis}_") for axis in ("normal", "shear", "third")] for vector in PLATE_VECTORS
}


def cauchy_stress(state: LoadState, mesh: TetMesh, materials: Materials) -> FloatArray:
    """Cauchy stress of each cell (m, 3, 3), MPa, LPS: deviator of the model, and mean pressure of the cell."""
    F = np.eye(3) + state.gradients
    stress = np.empty_like(F)
    for region, law in materials.items():
        cells = mesh.regions[region]
        kirchhoff = law.stress(F[cells]) @ F[cells].transpose(0, 2, 1)
        deviator = kirchhoff - np.trace(kirchhoff, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        volume = np.linalg.det(F[cells])[:, None, None]
        stress[cells] = deviator / volume + state.pressure_mpa[cells][:, None, None] * np.eye(3)
    return stress


def equivalent_stress(cauchy_mpa: FloatArray) -> FloatArray:
    """Von Mises equivalent (n,) of stresses (n, 3, 3): sqrt(3/2 s : s), s the deviator.

    Examples
    --------
    >>> equivalent_stress(np.array([np.diag([5.0, 2.0, 2.0]), [[0, 1, 0], [1, 0, 0], [0, 0, 0]]])).round(4).tolist()
    [3.0, 1.7321]
    """
    deviator = cauchy_mpa - np.trace(cauchy_mpa, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
    return np.asarray(np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2))))


def patch_volumes(mesh: TetMesh, jacobian: FloatArray) -> FloatArray:
    """Volume ratio of the cells around each node (n,), deformed over reference: det F of the nodal patch."""
    nodes = mesh.cells.ravel()
    before = np.bincount(nodes, np.repeat(mesh.volumes_mm3, 4))
    return np.asarray(np.bincount(nodes, np.repeat(mesh.volumes_mm3 * jacobian, 4)) / before)


def volume_share_off(mesh: TetMesh, state: LoadState, materials: Materials) -> float:
    """Volume fraction in which det F of the nodal patches differs by over 0.05 from that of the model, 1 + p / K.

    In a cell, det F of the patches is the mean over its nodes.
    """
    asked = np.empty(len(mesh.cells))
    for region, law in materials.items():
        cells = mesh.regions[region]
        asked[cells] = state.pressure_mpa[cells] / law.bulk_modulus_mpa
    jacobian = np.linalg.det(np.eye(3) + state.gradients) - asked
    off = np.abs(patch_volumes(mesh, jacobian) - 1.0)[mesh.cells].mean(axis=1) > _FAR
    return float(mesh.volumes_mm3[off].sum() / mesh.volumes_mm3.sum())


def why_not_reached(state: LoadState, materials: Materials) -> str:
    """How the search for the load ended, its likely cause and the next step."""
    least = float(state.strain.jacobian.min())
    steps = ", even with small increments"
    if doubts("", materials):
        steps = " (a material is unusual: below half of the normal load, the search is cut short)"
    return (
        f"no equilibrium was found beyond {100 * state.reached:.0f} % of the load{steps}; "
        f"{'cells are nearly inverted' if least < CROWDED else 'the tissue probably became unstable'} "
        f"(lowest det F {least:.2f}). Reduce the load, or check its unit and the material parameters."
    )


@dataclass(frozen=True, slots=True)
class RegionFigures:
    """Statistics of a region under a load; percentiles are by volume.

    Attributes
    ----------
    reached : float
        Fraction of the load; below 1, the statistics are those of the last converged increment.
    volume_ml : float
        In the reference configuration.
    shear_p50, shear_p90, shear_p95, shear_p99 : float
        Of the maximum shear strain (E1 - E3) / 2 (Green-Lagrange).
    stress_p50_mpa, stress_p90_mpa, stress_p95_mpa, stress_p99_mpa : float
        Of the von Mises equivalent of the Cauchy stress.
    above_ml : tuple of float
        Volume in which the maximum shear strain exceeds 0.2, 0.3, 0.4, 0.5.
    volume_change : float
        Of the whole region, as a fraction of its volume.
    stable_share : float
        Volume fraction in which the constitutive model is stable (Drucker) at the strain reached.
    crowded_share : float
        Volume fraction with det F below `fe.elements.CROWDED`, where the solver adds a resistance against folding.
    """

    load: str
    reached: float
    region: str
    volume_ml: float
    shear_p50: float
    shear_p90: float
    shear_p95: float
    shear_p99: float
    stress_p50_mpa: float
    stress_p90_mpa: float
    stress_p95_mpa: float
    stress_p99_mpa: float
    above_ml: tuple[float, ...]
    volume_change: float
    stable_share: float
    crowded_share: float


def region_figures(mesh: TetMesh, state: LoadState, materials: Materials) -> list[RegionFigures]:
    """Strain, stress and volume statistics of each region under a load.

    ``materials`` has one material for each region of the mesh; the rows are in its order.
    """
    strain = state.strain
    stress = equivalent_stress(cauchy_stress(state, mesh, materials))
    rows = []
    for region, law in materials.items():
        cells = mesh.regions[region]
        volumes, shear = mesh.volumes_mm3[cells], strain.max_shear[cells]
        s50, s90, s95, s99 = volume_percentiles(shear, volumes, _SHARES)
        m50, m90, m95, m99 = volume_percentiles(stress[cells], volumes, _SHARES)
        stable = law.is_stable(np.eye(3) + state.gradients[cells])
        rows.append(
            RegionFigures(
                state.load.name, state.reached, region, float(volumes.sum()) / 1000.0,
                s50, s90, s95, s99, m50, m90, m95, m99,
                tuple(volume_above(shear, volumes / 1000.0, SHEAR_THRESHOLDS).tolist()),
                float(volumes @ strain.jacobian[cells] / volumes.sum()) - 1.0,
                float(volumes[stable].sum() / volumes.sum()),
                float(volumes[strain.jacobian[cells] < CROWDED].sum() / volumes.sum()),
            )
        )  # fmt: skip
    return rows


def volume_percentiles(values: FloatArray, volumes: FloatArray, shares: Sequence[float]) -> tuple[float, ...]:
    """Values below which the given fractions (``shares``) of the volume lie.

    >>> volume_percentiles(np.array([0.1, 0.3, 0.2]), np.array([1.0, 1.0, 2.0]), [0.5])
    (0.2,)
    """
    order = np.argsort(values)
    below = np.cumsum(volumes[order]) / volumes.sum()
    at = np.minimum(np.searchsorted(below, shares), len(values) - 1)
    return tuple(float(v) for v in values[order][at])


def write_regions_csv(path: Path | str, rows: Sequence[RegionFigures]) -> None:
    """Write the statistics of regions as CSV, a row for each load and region; strain without unit, MPa, mL.

    `OutputError` if the file cannot be written.
    """
    columns = [
        "load", "reached", "region", "volume_ml", *(f"max_shear_p{p}" for p in (50, 90, 95, 99)),
        *(f"von_mises_p{p}_mpa" for p in (50, 90, 95, 99)), *(f"volume_above_{t:g}_ml" for t in SHEAR_THRESHOLDS),
        "volume_change", "stable_share", "crowded_share",
    ]  # fmt: skip
    table = []
    for row in rows:
        load, reached, region, *numbers = astuple(row)
        table.append([load, f"{reached:.4g}", region, *numbers[:9], *row.above_ml, *numbers[10:]])
    write_csv(Path(path), columns, table)


def write_curve_csv(path: Path, states: Sequence[LoadState]) -> None:
    """Write every converged increment: displacement, force, rotation and moment along the plate's axes; contact."""
    table = []
    for state in states:
        for at in state.curve:
            values = np.concatenate([getattr(at, vector) for vector in _COLUMNS] + [[at.area_mm2, at.pressure_mpa]])
            table.append([state.load.name, *(f"{v:.8g}" for v in values)])
    write_csv(path, ["load", *chain(*_COLUMNS.values()), "contact_area_mm2", "contact_pressure_mpa"], table)


def read_curve_csv(path: Path) -> dict[str, list[PlateState]]:
    """Read the file of `write_curve_csv`: the plate at every converged increment of each load, to eight digits.

    OSError, ValueError or KeyError for anything else.
    """
    curves: dict[str, list[PlateState]] = {}
    for row in read_rows(path):
        row |= {name.replace(*BEFORE): value for name, value in row.items()}
        vectors = {vector: np.array([float(row[c]) for c in columns]) for vector, columns in _COLUMNS.items()}
        plate = PlateState(**vectors, area_mm2=float(row["contact_area_mm2"]))
        curves.setdefault(row["load"], []).append(plate)
    return curves


def write_state(path: Path | str, mesh: TetMesh, state: LoadState, materials: Materials) -> None:
    """Write the results of a load as VTU: LPS mm and MPa, on the undeformed mesh (warp by ``displacement_mm``).

    At nodes: displacement, and det F of the nodal patch. In cells: number of the region, F, Green-Lagrange strain,
    maximum shear strain, det F, pressure (positive in tension) and Cauchy stress.
    """
    strain = state.strain
    region = np.zeros(len(mesh.cells), dtype=np.int64)
    for number, name in enumerate(mesh.regions, start=1):
        region[mesh.regions[name]] = number
    cell = {
        "region": region,
        "F": (np.eye(3) + state.gradients).reshape(-1, 9),
        "green_lagrange": strain.green_lagrange.reshape(-1, 9),
        "max_shear": strain.max_shear,
        "jacobian": strain.jacobian,
        "pressure_mpa": state.pressure_mpa,
        "cauchy_stress_mpa": cauchy_stress(state, mesh, materials).reshape(-1, 9),
    }
    point = {"displacement_mm": state.u_mm, "patch_jacobian": patch_volumes(mesh, strain.jacobian)}
    written = meshio.Mesh(mesh.points_mm, [("tetra", mesh.cells)], point, {name: [v] for name, v in cell.items()})
    with whole_file(Path(path)) as part:
        meshio.vtu.write(part, written, binary=True)


def read_state(path: Path) -> tuple[meshio.Mesh, FloatArray, FloatArray, FloatArray]:
    """Read a file of `write_state`: mesh, displacement (n, 3) mm, H = F - I (m, 3, 3), mean pressure (m,) MPa.

    ValueError or KeyError for anything else.
    """
    try:
        read = meshio.vtu.read(path)
    except Exception as damage:  # what meshio raises depends on the byte that is wrong
        raise ValueError(f"{path.name}: {type(damage).__name__}: {damage}") from damage
    cells = {name: blocks[0] for name, blocks in read.cell_data.items()}
    return read, read.point_data["displacement_mm"], cells["F"].reshape(-1, 3, 3) - np.eye(3), cells["pressure_mpa"]
