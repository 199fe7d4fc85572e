"""Simulation of a material set under its loads: results as arrays, files and figures."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from dvc import TetMesh
from dvc.arguments import checked
from dvc.arrays import FloatArray
from dvc.atomic_files import write_json
from dvc.deformation.nodal import OnMesh
from dvc.errors import InputError, few
from fe import result
from fe.decks import write_calculix, write_febio
from fe.elements import CROWDED, DESCRIPTIONS
from fe.materials import MODES, Materials
from fe.mesh_file import BONE
from fe.plate import Plate
from fe.problem import LoadStep, Problem, problems_of
from fe.published import MaterialSet, as_material_set
from fe.result import RegionFigures
from fe.simulation_files import RECORD, read_parts
from fe.solution import LoadState, Observer, SolverOptions, solve_paths

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MUCH = 0.05  # volume fraction with deviating det F of nodal patches, above which it is noted
_CROWD = 0.01  # volume fraction of a region with det F below `CROWDED`, above which it is noted


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """Results of a material set under its loads.

    Attributes
    ----------
    materials : MaterialSet
        Materials of the mesh's regions.
    mesh : TetMesh
        Undeformed, LPS mm.
    paths : tuple of tuple of LoadStep
        The requested loads, each path in the order of simulation.
    states : tuple of LoadState
        Results, in the order in which the loads were requested. On an incomplete path, the last one has ``reached``
        below 1; the path has none if a load that it passes was not reached.
    fixed : tuple of str
        Fixed surface sets.
    element : str
        As in `fe.elements`.
    turns : bool
        Whether the plate rotated freely.
    remarks : tuple of str
        Assumptions.
    regions : tuple of RegionFigures
        Strain, stress and volume of each region under each load.
    """

    materials: MaterialSet
    mesh: TetMesh
    paths: tuple[tuple[LoadStep, ...], ...]
    states: tuple[LoadState, ...]
    fixed: tuple[str, ...] = (BONE,)
    element: str = "P1"
    turns: bool = False
    remarks: tuple[str, ...] = ()
    regions: tuple[RegionFigures, ...] = field(init=False)

    def __post_init__(self) -> None:
        given = self.materials.materials
        rows = [row for state in self.states for row in result.region_figures(self.mesh, state, given)]
        object.__setattr__(self, "regions", tuple(rows))

    @classmethod
    def of(
        cls, materials: MaterialSet, problems: Sequence[Problem], states: Sequence[LoadState], loads: Sequence[LoadStep]
    ) -> Self:
        """The simulation of these problems, one for each path, with the final states of the requested loads."""
        first, order = problems[0], [load.name for load in loads]
        by_region, remarks = materials.for_regions(first.mesh.regions)
        remarks += tuple(note for one in problems for note in one.notes)
        return cls(
            replace(materials, materials=by_region), first.mesh, tuple(tuple(one.loads) for one in problems),
            tuple(sorted(states, key=lambda state: order.index(state.load.name))), tuple(first.fixed), first.element,
            first.plate.turns, remarks,
        )  # fmt: skip

    @property
    def name(self) -> str:
        """Name of the material set."""
        return self.materials.name

    @property
    def loads(self) -> tuple[LoadStep, ...]:
        """The requested loads."""
        return tuple(load for path in self.paths for load in path)

    @property
    def complete(self) -> bool:
        """Whether every load was reached, and every material is stable at the strain reached."""
        return len(self.states) == len(self.loads) and not self._unstable and all(s.reached == 1.0 for s in self.states)

    @property
    def timed_out(self) -> bool:
        """Whether it is incomplete only because its time limit was reached."""
        ended = all(state.reached == 1.0 or state.out_of_time for state in self.states)
        return not self.complete and not self._unstable and ended

    @property
    def _unstable(self) -> list[RegionFigures]:
        return [row for row in self.regions if row.stable_share < 1.0]

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions, and warnings about results."""
        reached = {state.load.name for state in self.states}
        notes = [
            f"{row.load}: the material of {row.region} violates Drucker stability in "
            f"{100 * (1.0 - row.stable_share):.1f} % of its volume; do not trust strain there. Use another material "
            "set or a smaller load."
            for row in self._unstable
        ]
        notes += [
            f"{row.load}: {100 * row.crowded_share:.1f} % of {row.region} is compressed below det F {CROWDED:g}. "
            "There, the solver adds an artificial stiffness, because this material cannot carry a pressure above its "
            f"bulk modulus ({self.materials.materials[row.region].bulk_modulus_mpa:.2g} MPa). Do not interpret strain "
            "in these cells; use a higher Poisson's ratio or a lower load."
            for row in self.regions
            if row.crowded_share > _CROWD
        ]
        for state in self.states:
            if state.out_of_time:
                began = f"at {100 * state.reached:.0f} % of the load; a run with a longer limit continues from there"
                when = began if len(state.curve) > 1 else "before the first equilibrium"
                notes.append(f"{state.load.name}: the time limit was reached {when}.")
        notes += [
            f"{state.load.name}: {result.why_not_reached(state, self.materials.materials)}"
            for state in self.states
            if state.reached < 1.0 and not state.out_of_time
        ]
        notes += [
            f"{load.name} was not tried: the load before it was not reached."
            for load in self.loads
            if load.name not in reached
        ]
        notes += [
            f"{state.load.name}: in {100 * share:.0f} % of the volume, the volume ratio of the mesh deviates by more "
            "than 5 % from the one that the pressure and the bulk modulus give. A finer mesh reduces this error."
            for state in self.states
            if (share := self._share_off(state)) > _MUCH
        ]
        return *self.remarks, *notes

    def _rows(self, state: LoadState) -> list[RegionFigures]:
        return [row for row in self.regions if row.load == state.load.name]

    def _share_off(self, state: LoadState) -> float:
        return result.volume_share_off(self.mesh, state, self.materials.materials)

    def state(self, load: str) -> LoadState:
        """The final state of a load.

        Raises
        ------
        InputError
            If no load of that name was simulated.
        """
        states = {state.load.name: state for state in self.states}
        if load not in states:
            raise InputError(f"No load '{load}' was simulated; simulated loads: {few(states) or 'none'}.")
        return states[load]

    def deformation(self, load: str) -> OnMesh:
        """The deformation under a load, which can be evaluated at any point of the mesh."""
        return OnMesh(self.mesh, self.state(load).u_mm)

    def cauchy_stress(self, load: str) -> FloatArray:
        """Cauchy stress of each cell (m, 3, 3) under a load, MPa, LPS."""
        return result.cauchy_stress(self.state(load), self.mesh, self.materials.materials)

    @property
    def headline(self) -> str:
        """The plate's displacement under each load, in a line."""
        plates = []
        for state in self.states:
            moved, along, _ = state.plate_displacement_mm
            sheared = f" (along the shear {along:z.1f})" if state.load.sheared else ""
            part = "" if state.reached == 1.0 else f" (ONLY {100 * state.reached:.0f} % of the load)"
            plates.append(f"{state.load.name} {moved:z.1f}{sheared}{part}")
        return f"plate displacement, mm: {', '.join(plates)}"

    def __str__(self) -> str:
        lines = []
        for state in self.states:
            shear = "; ".join(f"{row.region} {row.shear_p50:.3f} / {row.shear_p95:.3f}" for row in self._rows(state))
            (push, pull, _), (moved, along, _) = state.force_n, state.plate_displacement_mm
            force = f"{push:.1f} N normal, {pull:z.1f} N shear"
            part = "" if state.reached == 1 else f" ONLY {100 * state.reached:.0f} % of the load was reached ({force});"
            lines.append(
                f"{self.name}, {state.load.name}:{part} plate displacement {moved:z.2f} mm normal, {along:z.2f} mm "
                f"shear; max. shear, median / 95th percentile: {shear}"
            )
        return "\n".join([*lines, *(n if n.startswith(f"{self.name} ") else f"{self.name}: {n}" for n in self.notes)])

    @checked
    def plot(self, loads: Sequence[str] | None = None) -> "Figure":
        """Maximum shear strain where the bone is nearest to the plate, one panel per load; all by default."""
        from fe.figures import sagittal_slice

        return sagittal_slice(self.mesh, self.states if loads is None else [self.state(name) for name in loads])

    def _repr_html_(self) -> str:
        from dvc.report.drawing import png_bytes
        from dvc.report.page import Picture, Table, notebook_html

        rows: list[tuple[str | float, ...]] = []
        for state in self.states:
            plate = (round(float(v), 2) for v in (*state.plate_displacement_mm[:2], *state.force_n[:2]))
            shear = (f"{row.shear_p50:.3f} / {row.shear_p95:.3f}" for row in self._rows(state))
            rows.append((state.load.name, str(state.load), f"{100 * state.reached:.0f} %", *plate, *shear))
        head = (
            "load", "target", "reached", "normal displacement, mm", "shear displacement, mm", "normal force, N",
            "shear force, N",
        )  # fmt: skip
        title = "Plate displacement and force; maximum shear strain of each tissue, median / 95th percentile"
        table = Table(title, (*head, *self.materials.materials), tuple(rows))
        picture = Picture("Maximum shear strain", "", png_bytes(self.plot()))
        ended = f"{sum(state.reached == 1.0 for state in self.states)} of {len(self.loads)} loads reached"
        return notebook_html(f"{self.name}: {ended}", picture, table, notes=self.notes)

    def parameters(self) -> dict[str, object]:
        """Materials, loads and element as they are written to ``simulation.json``."""
        turns = "free to rotate about its pivot once it presses" if self.turns else "rotation locked"
        return {
            "set": self.name,
            "title": self.materials.title,
            "source": self.materials.source,
            "laws": {
                region: {
                    "law": material.description,
                    "vector_mpa": material.vector.tolist(),
                    "bulk_modulus_mpa": material.bulk_modulus_mpa,
                    "stable_stretches": {mode: material.stable_range(mode) for mode in MODES},
                }
                for region, material in self.materials.materials.items()
            },
            "region_numbers_in_vtu": {number: name for number, name in enumerate(self.materials.materials, start=1)},
            "paths": [[asdict(load) for load in path] for path in self.paths],
            "plate": "rigid; moved into contact, then to the prescribed forces and displacements, no force along the "
            f"third axis; {turns}",
            "element": f"{self.element}: {DESCRIPTIONS[self.element]}",
        }

    def write(self, folder: Path | str, *, record: Mapping[str, object] | None = None, fields: bool = True) -> None:
        """Write the simulation into a folder, as `mrstrain.simulate` does.

        Parameters
        ----------
        folder : path
            Created if it does not exist. Gets ``LOAD.vtu`` for each load, ``curve.csv`` (force and displacement of the
            plate), ``regions.csv``, ``simulation.json`` and figures.
        record : mapping, optional
            Provenance for ``simulation.json``; its "parameters" contain `parameters` and "fixed".
        fields : bool
            Whether to write the VTU files.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        from dvc.report.drawing import save_figure
        from fe import figures

        place = Path(folder)
        with suppress(OSError):  # writing the first file reports the error
            place.mkdir(parents=True, exist_ok=True)
        for state in self.states:
            if fields and len(state.curve) > 1:
                result.write_state(place / f"{state.load.name}.vtu", self.mesh, state, self.materials.materials)
        result.write_regions_csv(place / "regions.csv", self.regions)
        result.write_curve_csv(place / "curve.csv", self.states)
        parameters = {"fixed": list(self.fixed), "turns": self.turns} | self.parameters()
        content = {"outcome": {s.load.name: self._outcome(s) for s in self.states}, "notes": list(self.notes)}
        write_json(place / RECORD, content | dict(record or {"parameters": parameters}))
        save_figure(place / "slices", self.plot())
        save_figure(place / "force_displacement", figures.force_displacement(self.states), figures.forces(self.states))

    def write_decks(self, folder: Path | str) -> None:
        """Write input files of each load with quadratic tetrahedra: ``LOAD.inp`` (CalculiX), ``LOAD.feb`` (FEBio 4).

        Raises
        ------
        InputError
            If one of the two does not support the constitutive model of a region.
        """
        given = self.mesh, self.materials.materials
        with suppress(OSError):
            Path(folder).mkdir(parents=True, exist_ok=True)
        for state in self.states:
            stem = Path(folder) / state.load.name
            write_calculix(Path(f"{stem}.inp"), *given, state, fixed=self.fixed, quadratic=True)
            write_febio(Path(f"{stem}.feb"), *given, state, fixed=self.fixed, quadratic=True)

    def _outcome(self, state: LoadState) -> dict[str, object]:
        assert state.plate_axes is not None
        plate = state.plate
        return {
            "reached": state.reached,
            "out_of_time": state.out_of_time,
            "stable_share": min(row.stable_share for row in self._rows(state)),
            "plate_axes_lps": state.plate_axes.tolist(),
            **{f"plate_{vector}": getattr(plate, vector).tolist() for vector in result.PLATE_VECTORS},
            "contact_area_mm2": plate.area_mm2,
            "contact_pressure_mpa": plate.pressure_mpa if plate.area_mm2 > 0.0 else None,
            "nodes_on_plate": len(state.on_plate),
            "iterations": state.iterations,
            "seconds": round(state.seconds, 1),
            "volume_share_with_patch_det_f_off_by_5_percent": self._share_off(state),
        }

    @classmethod
    def read(cls, folder: Path | str, mesh: TetMesh | None = None) -> Self:
        """Read a simulation from the folder of `write` or `mrstrain.simulate`.

        Parameters
        ----------
        mesh : TetMesh, optional
            The simulated mesh, for its surface sets, which the files do not contain. Without it, outer faces that did
            not move are named after the fixed surface set (or "bone" if there are several), and the other outer faces
            "skin".

        Raises
        ------
        InputError
            If the folder has no simulation, a file is damaged, or the simulation was made on another mesh.

        Notes
        -----
        Plate states before the end of a load have the eight digits of ``curve.csv``; everything else is exact.
        """
        return cls(**read_parts(Path(folder), mesh))


@checked
def simulate(
    mesh: TetMesh, materials: MaterialSet | Materials | Path | str, plate: Plate | Mapping[str, Plate],
    loads: Sequence[LoadStep], *, fixed: Sequence[str] = (BONE,), element: str = "P1",
    options: SolverOptions | None = None, observer: Observer | None = None,
) -> Simulation:  # fmt: skip
    """Simulate a rigid plate that presses and shears soft tissue.

    Parameters
    ----------
    mesh : TetMesh
        Undeformed, LPS mm, with the surface set "skin", which the plate may touch, and the fixed surface sets.
    materials : MaterialSet, str, path, or mapping of region to Material
        A material set, the name of a published one, the path of a file with one (`fe.material_set`), or a material for
        each region of the mesh.
    plate : Plate, or mapping of load name to Plate
        With its outward normal and direction of shear, LPS; both are needed, even without shear.
    loads : sequence of LoadStep
        Forces (N) or plate displacements (mm) along these directions. Loads with the same normal force are simulated as
        one load path, in the order of their shear (`fe.paths_of`). The first load of a path continues from the largest
        smaller load without shear, unless the plate rotates freely.
    fixed : sequence of str
        Fixed surface sets.
    element : {"P1", "MINI", "P2"}
        Linear, with a bubble, or quadratic; see `fe.elements`.
    options : SolverOptions, optional
        Threads, time limit and tolerance.
    observer : Observer, optional
        Receives the progress of each path.

    Returns
    -------
    Simulation
        For each load that was started, ``state(name)`` has the displacement of the nodes (n, 3) mm and the displacement
        gradient of the cells (m, 3, 3), both on the undeformed mesh in LPS; ``strain`` from it (Green-Lagrange); the
        pressure (m,) MPa; and the plate's displacement (3,) mm and force (3,) N, along the normal force, the shear and
        their cross product. `Simulation.regions` has strain, stress and volume statistics by region.

    Raises
    ------
    InputError
        As `fe.Problem` and `fe.material_set`; before anything is computed.

    Notes
    -----
    A load that cannot be reached does not raise an error: its state is the last converged increment, with ``reached``
    below 1, and `Simulation.complete` is False.
    """
    chosen = as_material_set(materials)
    (by_region, notes), observer = chosen.for_regions(mesh.regions), observer or Observer()
    problems = problems_of(mesh, by_region, plate, loads, fixed, element)
    for note in (*notes, *(note for one in problems for note in one.notes)):
        observer.log(note)
    return Simulation.of(chosen, problems, solve_paths(problems, options, observer), loads)
