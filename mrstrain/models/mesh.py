"""`mesh`: a label map's soft tissues as tetrahedra, with a table of the mesh's quality and a picture."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from dvc import TetMesh, read_labels
from dvc.errors import InputError, OutputError
from dvc.measurement.subject import is_bones_name
from fe import SKIN, MeshQuality, Plate, figures, mesh_labels, write_tet_mesh
from mrstrain.options.door import door
from mrstrain.options.modelling import Labelling, Meshing
from mrstrain.records.inputs import make_output
from mrstrain.records.provenance import provenance

_CARE_VOLUME, _CARE_ANGLE_DEG = 0.02, 10.0
_INFERIOR, _FORWARD = (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)


@dataclass(frozen=True, slots=True)
class Meshed:
    """What `mesh` wrote."""

    out: Path
    mesh: TetMesh
    quality: MeshQuality

    def summary(self) -> list[str]:
        """A few lines for a person."""
        q = self.quality
        volumes = ", ".join(f"{name} {made:.1f} ({kept:.1f})" for name, made, kept in q.volumes_ml)
        low, middle, high = q.edge_mm
        lines = [
            f"{q.cells} tetrahedra, {q.nodes} nodes; edges {middle:.2f} mm ({low:.2f} to {high:.2f}), dihedral angles "
            f"{q.least_angle_deg:.1f} to {q.greatest_angle_deg:.1f} degrees",
            f"Volumes, mL (in the label map): {volumes}",
            "Facets: " + ", ".join(f"{name} {len(rows)}" for name, rows in self.mesh.facets.items()),
        ]
        lines += [
            f"CARE: {name} differs by {made / given - 1.0:+.1%} from its volume in the label map."
            for name, made, given in q.volumes_ml
            if abs(made - given) > _CARE_VOLUME * given
        ]
        if q.least_angle_deg < _CARE_ANGLE_DEG:
            lines.append(f"CARE: the least dihedral angle is {q.least_angle_deg:.1f} degrees.")
        lines += [
            f"{share:.0%} of the cells of {name} reach through it, one cell thick; --finer makes it thicker."
            for name, share in q.thin
        ]
        lines += [
            f"CARE: {name} is meshed as soft tissue, and called as a bone is: cut it out with --bone {name}."
            for name in self.mesh.regions
            if is_bones_name(name)
        ]
        if not any(name.casefold() == SKIN for name in self.mesh.regions):
            lines.append(
                "CARE: no tissue is called skin, so the cut (where the label map ends) cannot be told from the outer "
                "surface: it counts as 'skin', which the plate may touch, and there are no facets 'cut'."
            )
        return [*lines, f"Mesh: {self.out}"]


@door
def mesh(
    labels: Path | str, *, out: Path | str, labelling: Labelling, meshing: Meshing,
    watch: Callable[[float], None] | None = None,
) -> Meshed:  # fmt: skip
    """Mesh the soft tissues of a label map.

    Parameters
    ----------
    labels : path
        As in `register`.
    out : path
        The mesh, ending in .vtu; beside it a .json with names and quality, and a .png.
    labelling, meshing, watch
        As in `fe.mesh_labels`.

    Raises
    ------
    InputError, OutputError, MrstrainError
        As there; or if the output is not a .vtu, or would replace an input.
    """
    target, files = Path(out), {"labels": [Path(labels)], **labelling.files}
    if target.suffix.lower() != ".vtu":
        raise InputError(f"--out is the mesh itself and ends in .vtu; got {target}.")
    written = [target.with_suffix(ending).resolve() for ending in (".vtu", ".json", ".png")]
    for path in (Path(labels), *labelling.paths):
        if path.resolve() in [target.resolve(), *written]:
            raise OutputError(f"{path} would be replaced by a result. Choose another --out.")
    given = read_labels(labels, labelling.names)
    make_output(target.parent)
    how = meshing.model_dump()
    made, quality = mesh_labels(given, **how, bones=labelling.bones, watch=watch or (lambda _: None))
    del how["limit_s"]  # no mesh depends on it
    record = provenance("mesh", files, how | {"bones": list(labelling.bones)})
    write_tet_mesh(target, made, {"quality": asdict(quality)} | record)
    figures.write_figure(target.with_suffix(".png"), figures.mesh_slice(made, Plate(_INFERIOR, _FORWARD)))
    return Meshed(target, made, quality)
