"""Input files (decks) of a simulated load for other solvers, with the same mesh, materials, supports and plate nodes.

A hyperelastic state depends on the final positions of its supports, not on the path. In a deck, bone is fixed and the
nodes on the plate are moved to their final positions. Its solution is therefore the simulated state, and its reactions
are the plate's forces; contact need not be solved again. CalculiX reads one format (Abaqus has the same keywords),
FEBio 4 the other.
"""

from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray, IntArray
from dvc.atomic_files import write_whole
from dvc.errors import InputError
from fe.elements import Space, edges_of
from fe.hyperelastic import OGDEN
from fe.materials import Material, Materials, NeoHooke, Ogden, Yeoh
from fe.mesh_file import BONE
from fe.solution import LoadState

_UNUSED = 1e30  # D of an unused volumetric term: its stiffness is 1 / D
_PER_LINE = 12
_FEBIO_CONTROL = """<Control>
  <analysis>STATIC</analysis><time_steps>20</time_steps><step_size>0.05</step_size>
  <time_stepper type="default">
    <max_retries>10</max_retries><opt_iter>12</opt_iter><dtmin>1e-4</dtmin><dtmax>0.1</dtmax>
  </time_stepper>
  <solver type="solid"><symmetric_stiffness>symmetric</symmetric_stiffness></solver>
</Control>"""
_FEBIO_LOADS = """<LoadData><load_controller id="1" type="loadcurve">
  <interpolate>LINEAR</interpolate><points><pt>0,0</pt><pt>1,1</pt></points>
</load_controller></LoadData>"""
_FEBIO_OUTPUT = """<Output><plotfile type="febio">
  <var type="displacement" /><var type="stress" /><var type="Lagrange strain" /><var type="reaction forces" />
</plotfile></Output>"""


def write_calculix(
    path: Path | str, mesh: TetMesh, materials: Materials, state: LoadState, *,
    fixed: Sequence[str] = (BONE,), quadratic: bool = False,
) -> None:  # fmt: skip
    """Write a CalculiX deck (.inp) of a state, mm, N and MPa, LPS.

    Parameters
    ----------
    path : path
        Ending in .inp. CalculiX prints the displacement of all nodes and the total force on the plate to the .dat file.
    materials : mapping of region to Material
        Neo-Hooke, Yeoh and Ogden; the volumetric energy is as in `fe.materials`, the same as CalculiX's (D1 = 2 / K).
    fixed : sequence of str
        Surface sets that do not move.
    quadratic : bool
        C3D10 instead of C3D4. Linear tetrahedra without a pressure field lock in nearly incompressible tissue: use C3D4
        only to compare codes.

    Raises
    ------
    InputError
        For the Hencky model, which CalculiX does not have.
    """
    write_whole(Path(path), "\n".join(_deck(mesh, materials, state, fixed, quadratic)) + "\n")


def _deck(
    mesh: TetMesh, materials: Materials, state: LoadState, fixed: Sequence[str], quadratic: bool
) -> Iterator[str]:
    space = _space(mesh, quadratic)
    yield from (f"** {line}" for line in _about(state))
    yield "*NODE, NSET=NALL"
    for number, (x, y, z) in enumerate(space.nodes_mm.tolist(), start=1):
        yield f"{number}, {x:.12g}, {y:.12g}, {z:.12g}"
    for region in materials:
        yield f"*ELEMENT, TYPE={'C3D10' if quadratic else 'C3D4'}, ELSET={_short('E', region, materials)}"
        for cell in mesh.regions[region]:
            yield f"{cell + 1}, " + ", ".join(str(n + 1) for n in space.cells[cell])
    for region, law in materials.items():
        yield f"*MATERIAL, NAME={_short('M', region, materials)}"
        yield from _calculix_law(region, law)
        yield f"*SOLID SECTION, ELSET={_short('E', region, materials)}, MATERIAL={_short('M', region, materials)}"
    held, on_plate, moved = _supports(mesh, space, state, fixed)
    for name, nodes in (("NBONE", held), ("NPLATE", on_plate)):
        yield f"*NSET, NSET={name}"
        for start in range(0, len(nodes), _PER_LINE):
            yield ", ".join(str(n + 1) for n in nodes[start : start + _PER_LINE]) + ","
    yield from ("*BOUNDARY", "NBONE, 1, 3, 0.")
    yield from ("*STEP, NLGEOM, INC=200", "*STATIC", "0.1, 1., 1e-5, 0.25", "*BOUNDARY")
    for node, u in zip(on_plate, moved, strict=True):
        yield from (f"{node + 1}, {axis + 1}, {axis + 1}, {u[axis]:.12g}" for axis in range(3))
    yield from ("*NODE PRINT, NSET=NALL", "U", "*NODE PRINT, NSET=NPLATE, TOTALS=ONLY", "RF")
    yield from ("*NODE FILE", "U", "*EL FILE", "S, E", "*END STEP")


def _supports(
    mesh: TetMesh, space: Space, state: LoadState, fixed: Sequence[str]
) -> tuple[IntArray, IntArray, FloatArray]:
    """Fixed nodes, nodes on the plate, and the displacement of the latter; midpoint nodes follow their edges."""
    held = space.nodes_on(np.concatenate([mesh.facets[name] for name in fixed]))
    on_plate = np.sort(state.on_plate)
    moved = state.u_mm[on_plate]
    if space.cells.shape[1] > 4:
        others = np.concatenate([rows for name, rows in mesh.facets.items() if name not in fixed])
        ends = edges_of(others[np.isin(others, on_plate).all(axis=1)])
        on_plate = np.append(on_plate, space.middles(ends))
        moved = np.concatenate([moved, state.u_mm[ends].mean(axis=1)])
    return held, on_plate, moved


def _calculix_law(region: str, law: Material) -> tuple[str, str]:
    polynomial, terms = law.vector[:OGDEN].tolist(), law.vector[OGDEN:].tolist()
    d1, count = 2.0 / law.bulk_modulus_mpa, len(terms) // 2
    if count > 3:
        raise InputError(f"{region}: CalculiX takes Ogden models of at most three terms; this one has {count}.")
    forms = {
        NeoHooke: ("NEO HOOKE", [polynomial[0], d1]),
        Yeoh: ("YEOH", [*polynomial[:3], d1, _UNUSED, _UNUSED]),
        Ogden: (f"OGDEN, N={count}", [*terms, d1, *[_UNUSED] * (count - 1)]),
    }
    if type(law) not in forms:
        raise InputError(
            f"{region}: CalculiX has no constitutive model that is linear in logarithmic strain. (Its *ELASTIC is the "
            "Saint Venant-Kirchhoff model, which collapses in compression.) Choose another material set for the deck."
        )
    kind, numbers = forms[type(law)]
    return f"*HYPERELASTIC, {kind}", ", ".join(f"{number:.12g}" for number in numbers)


def write_febio(
    path: Path | str, mesh: TetMesh, materials: Materials, state: LoadState, *,
    fixed: Sequence[str] = (BONE,), quadratic: bool = False,
) -> None:  # fmt: skip
    """Write an FEBio 4 deck (.feb) of a state, mm, N and MPa, LPS; parameters as `write_calculix`.

    The volumetric energy is FEBio's pressure model "Abaqus", K / 2 (J - 1)^2, the same as in `fe.materials`. Elements
    are numbered region by region, in the order of ``materials``.

    Raises
    ------
    InputError
        For the Hencky model.
    """
    space = _space(mesh, quadratic)
    held, on_plate, moved = _supports(mesh, space, state, fixed)
    root = ElementTree.Element("febio_spec", version="4.0")
    root.append(ElementTree.Comment(" " + "\n    ".join(_about(state)) + " "))
    _child(root, "Module", type="solid")
    root.append(ElementTree.fromstring(_FEBIO_CONTROL))
    listed = _child(root, "Material")
    for number, (region, law) in enumerate(materials.items(), start=1):
        kind, numbers = _febio_law(region, law)
        material = _child(listed, "material", id=str(number), name=_short("M", region, materials), type=kind)
        for name, value in (*numbers.items(), ("k", f"{law.bulk_modulus_mpa:.12g}")):
            _child(material, name, value)
        _child(material, "pressure_model", "Abaqus")
    whole = _child(root, "Mesh")
    nodes = _child(whole, "Nodes", name="all")
    for number, place in enumerate(space.nodes_mm.tolist(), start=1):
        _child(nodes, "node", ",".join(f"{v:.12g}" for v in place), id=str(number))
    elements_so_far = count(1)  # FEBio's reader refuses a number that is not above all before it
    for region in materials:
        elements = _child(whole, "Elements", type="tet10" if quadratic else "tet4", name=_short("E", region, materials))
        for cell in mesh.regions[region]:
            _child(elements, "elem", ",".join(str(n + 1) for n in space.cells[cell]), id=str(next(elements_so_far)))
    for name, members in (("bone", held), ("plate", on_plate)):
        _child(whole, "NodeSet", ",".join(str(n + 1) for n in members), name=name)
    domains = _child(root, "MeshDomains")
    for region in materials:
        _child(domains, "SolidDomain", name=_short("E", region, materials), mat=_short("M", region, materials))
    data = _child(root, "MeshData")
    boundary = _child(root, "Boundary")
    still = _child(boundary, "bc", name="bone", type="zero displacement", node_set="bone")
    for number, axis in enumerate("xyz"):
        _child(still, f"{axis}_dof", "1")
        values = _child(data, "NodeData", name=f"u{axis}", node_set="plate", data_type="scalar")
        for local, u in enumerate(moved[:, number], start=1):
            _child(values, "node", f"{u:.12g}", lid=str(local))
        bc = _child(boundary, "bc", name=f"plate {axis}", type="prescribed displacement", node_set="plate")
        _child(bc, "dof", axis)
        _child(bc, "value", f"u{axis}", lc="1", type="map")
        _child(bc, "relative", "0")
    root.extend(map(ElementTree.fromstring, (_FEBIO_LOADS, _FEBIO_OUTPUT)))
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    write_whole(Path(path), f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')


def _child(parent: ElementTree.Element, tag: str, text: str | None = None, /, **attributes: str) -> ElementTree.Element:
    made = ElementTree.SubElement(parent, tag, attributes)
    made.text = text
    return made


def _febio_law(region: str, law: Material) -> tuple[str, dict[str, str]]:
    """The name of a material in FEBio, and its parameters.

    Yeoh's law is written as an energy, which FEBio differentiates. FEBio 4.11 has a material "Yeoh", too, but its
    stress lacks the factor i of dW/dI1 = sum i c_i (I1 - 3)^(i - 1): the stress of another law than its energy's.
    """
    c10, c20, c30 = law.vector[:3].tolist()
    pairs = law.vector[OGDEN:].reshape(-1, 2).tolist()
    numbers = {f"c{n}": 2.0 * mu for n, (mu, _) in enumerate(pairs, start=1)}  # c = 2 mu0, see Ogden.from_febio
    numbers |= {f"m{n}": alpha for n, (_, alpha) in enumerate(pairs, start=1)}
    forms = {
        NeoHooke: ("Mooney-Rivlin", {"c1": f"{c10:.12g}", "c2": "0"}),
        Yeoh: ("uncoupled hyperelastic", {"W": f"{c10:.12g}*(I1-3){c20:+.12g}*(I1-3)^2{c30:+.12g}*(I1-3)^3"}),
        Ogden: ("Ogden", {name: f"{number:.12g}" for name, number in numbers.items()}),
    }
    if type(law) not in forms:
        raise InputError(f"{region}: FEBio decks do not support the model '{law.law}'. Choose another material set.")
    return forms[type(law)]


def _about(state: LoadState) -> tuple[str, ...]:
    force = ", ".join(f"{f:.4g}" for f in state.force_n)
    return (
        f"Written by mrstrain: state at {100 * state.reached:.0f} % of {state.load.name}. Units mm, N, MPa; frame LPS.",
        "Bone is fixed; nodes on the plate are moved to their final positions. There is no contact and no force.",
        f"Expected plate force along the normal force, the shear and their cross product: {force} N.",
        "Small deviations come from the element type, which differs from that of the simulation.",
    )


def _space(mesh: TetMesh, quadratic: bool) -> Space:
    return Space.on(mesh, "P2" if quadratic else "P1", np.zeros(len(mesh.cells), dtype=np.int64))


def _short(prefix: str, region: str, materials: Materials) -> str:
    """A unique name that is valid in CalculiX: letters and digits, under 20 characters."""
    return f"{prefix}{list(materials).index(region) + 1}" + "".join(c for c in region.upper() if c.isalnum())[:15]
