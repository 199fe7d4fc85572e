"""`mesh`: tetrahedral mesh of the soft tissues of a label map, with its quality and a figure."""

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from dvc import Grid, LabelMap, TetMesh, read_labels, write_labels
from dvc.errors import InputError, MrstrainError, OutputError
from dvc.images.bone_names import is_bones_name
from dvc.measurement.subject import bones_of
from dvc.report.drawing import ENDINGS, save_figure
from fe import SKIN, MeshQuality, Plate, figures, mesh_labels, write_tet_mesh
from mrstrain.options.door import door
from mrstrain.options.modelling import Labelling, Meshing
from mrstrain.records.durations import MESHING, cells_of, meshing as expected_of
from mrstrain.records.inputs import alone, output_folder, read_given_labels
from mrstrain.records.progress import OnProgress, expect
from mrstrain.records.provenance import provenance
from mrstrain.records.time_left import WRITING

_CARE_VOLUME, _CARE_ANGLE_DEG = 0.02, 10.0
_CASE = "mesh"  # of progress
_INFERIOR, _FORWARD = (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)


@dataclass(frozen=True, slots=True)
class Meshed:
    """Result of `mesh`."""

    out: Path
    mesh: TetMesh
    quality: MeshQuality
    asked: Meshing

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        q = self.quality
        volumes = ", ".join(f"{name} {made:.1f} ({kept:.1f})" for name, made, kept in q.volumes_ml)
        low, middle, high = q.edge_mm
        finer = "" if self.asked.finer is None else " ({1:g} mm in {0})".format(*self.asked.finer)
        lines = [
            f"{q.cells} tetrahedra, {q.nodes} nodes; requested edge length {self.asked.edge_mm:g} mm{finer}, median of "
            f"the mesh {middle:.2f} mm (5th to 95th percentile {low:.2f} to {high:.2f}); dihedral angles "
            f"{q.least_angle_deg:.1f} to {q.greatest_angle_deg:.1f} degrees",
            f"Volumes, mL (in the label map): {volumes}",
            "Surface sets, faces: " + ", ".join(f"{name} {len(rows)}" for name, rows in self.mesh.facets.items()),
        ]
        lines += [
            f"WARNING: the volume of {name} differs by {100 * (made / given - 1.0):+.1f} % from the label map."
            for name, made, given in q.volumes_ml
            if abs(made - given) > _CARE_VOLUME * given
        ]
        if q.least_angle_deg < _CARE_ANGLE_DEG:
            lines.append(f"WARNING: the smallest dihedral angle is {q.least_angle_deg:.1f} degrees.")
        lines += [
            f"{100 * share:.0f} % of the cells of {name} extend through its whole thickness. Give a shorter edge "
            "length there: --finer, or finer under [mesh] in a study file."
            for name, share in q.thin
        ]
        lines += [
            f"WARNING: {name} is meshed as soft tissue, but has the name of a bone. If it is one, add it to the bones."
            for name in self.mesh.regions
            if is_bones_name(name)
        ]
        if not any(name.casefold() == SKIN for name in self.mesh.regions):
            lines.append(
                "WARNING: no tissue is named skin, so the truncation surface (where the label map ends) is not "
                "detected: all outer faces are in 'skin', which the plate may touch, and there is no surface set 'cut'."
            )
        return [*lines, f"Mesh: {self.out}"]


@door
def mesh(
    labels: Path | str, *, out: Path | str, labelling: Labelling, meshing: Meshing, progress: OnProgress | None = None,
) -> Meshed:  # fmt: skip
    """Mesh the soft tissues of a label map.

    Parameters
    ----------
    labels : path
        As in `register`.
    out : path
        The mesh, ending in .vtu; next to it are written a .json with names and quality, and a slice as .png and .pdf.
    labelling, meshing
        As in `fe.mesh_labels`.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError, OutputError, MrstrainError
        As `fe.mesh_labels`; or if the output is not a .vtu, or would overwrite an input.
    """
    target, files = Path(out), {"labels": [Path(labels)], **labelling.files}
    if target.suffix.lower() != ".vtu":
        raise InputError(f"The output (out) is the mesh file and must end in .vtu; got {target}.")
    written = [target.with_suffix(ending).resolve() for ending in (".vtu", ".json", *ENDINGS)]
    for path in (Path(labels), *labelling.paths):
        if path.resolve() in [target.resolve(), *written]:
            raise OutputError(f"{path} is an input and would be overwritten. Choose another output file (out).")
    given = read_given_labels(labels, labelling.names)
    with output_folder(target.parent), alone(target, target.with_name(f".{target.name}.lock")):
        how = meshing.model_dump()
        bones = bones_of(given, labelling.bones)
        tell = progress or (lambda *_: None)
        expect(progress, {_CASE: expected_of(cells_of(given, bones, meshing.edge_mm))})
        made, quality = mesh_labels(given, **how, bones=bones, watch=partial(tell, _CASE, MESHING))
        tell(_CASE, WRITING, 0.0)
        del how["limit_s"]  # does not affect the mesh
        record = provenance("mesh", files, how | {"bones": list(bones)})
        write_tet_mesh(target, made, {"quality": asdict(quality)} | record)
    save_figure(target.with_suffix(""), figures.mesh_slice(made, Plate(_INFERIOR, _FORWARD)))
    tell(_CASE, WRITING, 1.0)
    return Meshed(target, made, quality, meshing)


def mesh_coarser(
    labels: Path, *, out: Path, ratio: float, labelling: Labelling, meshing: Meshing,
    progress: OnProgress | None = None,
) -> Meshed:  # fmt: skip
    """Mesh a label map with edges that are longer by a ratio, and voxels larger by it unless a tissue would be lost.

    In thin tissues, the voxels limit the size of the cells, not the edge length. The label map with these voxels is
    written next to the mesh. Other parameters and errors as in `mesh`.
    """
    longer = meshing.model_copy(update={"edge_mm": ratio * meshing.edge_mm})
    if longer.finer is not None:
        longer = longer.model_copy(update={"finer": longer.finer._replace(edge_mm=ratio * longer.finer.edge_mm)})
    out.parent.mkdir(parents=True, exist_ok=True)
    place = out.with_name("labels.nii.gz")
    write_labels(place, _coarser(read_labels(labels, labelling.names), ratio))
    beside = labelling.model_copy(update={"names": place.with_name("labels.csv")})
    try:
        return mesh.with_options(place, out=out, labelling=beside, meshing=longer, progress=progress)
    except MrstrainError:  # a tissue is too thin for these voxels
        return mesh.with_options(labels, out=out, labelling=labelling, meshing=longer, progress=progress)


def _coarser(labels: LabelMap, ratio: float) -> LabelMap:
    """A label map with voxels that are larger by a ratio, each with the label at its centre."""
    grid = labels.grid
    i, j, k = (max(int(n / ratio), 1) for n in grid.shape)
    wide = Grid((i, j, k), ratio * grid.spacing_mm, grid.points_at(np.full(3, 0.5 * (ratio - 1.0))), grid.direction)
    at = np.rint(grid.indices_of(wide.points().reshape(-1, 3))).astype(np.int64)
    at = np.clip(at, 0, np.array(grid.shape) - 1)
    return LabelMap(wide, labels.labels[tuple(at.T)].reshape(i, j, k), labels.names)
