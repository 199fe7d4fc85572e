"""A cube of tetrahedra written in every format that is read, as the programs write it."""

from __future__ import annotations

import itertools
from pathlib import Path

import meshio
import numpy as np

SIDE = 10.0


def block(n: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A cube of 10 mm, off the origin, cut into 6 n^3 tetrahedra of positive volume."""
    axis = np.linspace(0.0, SIDE, n + 1)
    points = np.array(list(itertools.product(axis, axis, axis))) + np.array([5.0, -20.0, 40.0])
    cells = []
    for corner in itertools.product(range(n), repeat=3):
        for order in itertools.permutations(range(3)):
            path = [np.array(corner)]
            for step in order:
                path.append(path[-1] + np.eye(3, dtype=int)[step])
            cell = [int(np.dot(node, [(n + 1) ** 2, n + 1, 1])) for node in path]
            odd = order in {(0, 2, 1), (1, 0, 2), (2, 1, 0)}
            cells.append([cell[0], cell[1], cell[3], cell[2]] if odd else cell)
    return points, np.array(cells)


def skin(cells: np.ndarray) -> np.ndarray:
    """Two triangles that are faces of the mesh."""
    return cells[:2, :3]


TAGS = np.random.default_rng(1).permutation(np.arange(100, 154, 2))  # numbers with gaps, in no order


def write_gmsh41(path: Path, points: np.ndarray, cells: np.ndarray, *, binary: bool) -> None:
    """Two physical groups of tetrahedra and one of triangles, nodes in two blocks, numbered by TAGS."""
    # dimension, tag, gmsh's number of the element type, nodes
    groups = [(2, 7, 2, skin(cells)), (3, 1, 4, cells[:20]), (3, 2, 4, cells[20:])]
    names = '$PhysicalNames\n3\n2 7 "sole"\n3 1 "fat"\n3 2 "skin"\n$EndPhysicalNames\n'
    out = bytearray(f"$MeshFormat\n4.1 {int(binary)} 8\n".encode())

    def ints(*values: int) -> bytes:
        return np.array(values, "<i4").tobytes() if binary else (" ".join(map(str, values)) + " ").encode()

    def sizes(*values: int) -> bytes:
        return np.array(values, "<u8").tobytes() if binary else (" ".join(map(str, values)) + " ").encode()

    def reals(values: np.ndarray) -> bytes:
        text = " ".join(map(repr, values.tolist())) + " "
        return values.astype("<f8").tobytes() if binary else text.encode()

    end = b"" if binary else b"\n"
    out += (ints(1) + b"\n" if binary else b"") + b"$EndMeshFormat\n" + names.encode() + b"$Entities\n"
    out += sizes(0, 0, 1, 2) + end
    for dim, tag, *_ in groups:
        out += ints(tag) + reals(np.zeros(6)) + sizes(1) + ints(tag) + sizes(0) + end
        assert dim in (2, 3)
    out += b"\n$EndEntities\n$Nodes\n" + sizes(2, 27, 100, 152) + end
    for part in (slice(0, 11), slice(11, 27)):
        out += ints(3, 1, 0) + sizes(len(TAGS[part])) + end
        out += b"".join(sizes(int(tag)) + end for tag in TAGS[part])
        out += b"".join(reals(point) + end for point in points[part])
    out += b"\n$EndNodes\n$Elements\n" + sizes(3, 50, 1, 50) + end
    number = itertools.count(1)
    for dim, tag, kind, nodes in groups:
        out += ints(dim, tag, kind) + sizes(len(nodes)) + end
        out += b"".join(sizes(next(number), *map(int, TAGS[row])) + end for row in nodes)
    path.write_bytes(bytes(out + b"\n$EndElements\n"))


def write_gmsh22(path: Path, points: np.ndarray, cells: np.ndarray) -> None:
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "3"]
    lines += ['2 7 "sole"', '3 1 "fat"', '3 2 "skin"', "$EndPhysicalNames", "$Nodes", "27"]
    lines += [f"{tag} {x!r} {y!r} {z!r}" for tag, (x, y, z) in zip(TAGS, points.tolist(), strict=True)]
    lines += ["$EndNodes", "$Elements", "50"]
    elements = [(2, 7, row) for row in skin(cells)]
    elements += [(4, 1 if i < 20 else 2, row) for i, row in enumerate(cells)]
    for number, (kind, group, row) in enumerate(elements, start=1):
        lines.append(f"{number} {kind} 2 {group} {group} " + " ".join(str(TAGS[i]) for i in row))
    path.write_text("\n".join([*lines, "$EndElements", ""]))


def write_abaqus(path: Path, points: np.ndarray, cells: np.ndarray, kind: str = "C3D4H") -> None:
    """All that meshio 5.3.5 stumbles over: hybrid elements, a set at the nodes, several blocks of nodes."""
    rows = [f"{tag}, {x!r}, {y!r}, {z!r}" for tag, (x, y, z) in zip(TAGS, points.tolist(), strict=True)]
    lines = ["*HEADING", "a heel", "** comment", "*NODE, NSET=N1", *rows[:11], "*Node", *rows[11:]]
    lines += ["*ELEMENT, TYPE=S3, ELSET=sole"]
    lines += [f"{901 + i}, {a}, {b}, {c}" for i, (a, b, c) in enumerate(TAGS[skin(cells)])]
    lines += [f"*Element, type={kind},", " elset=Fat"]
    lines += [f"{i + 1}, {', '.join(str(TAGS[j]) for j in row)}" for i, row in enumerate(cells[:20])]
    lines += [f"*ELEMENT, TYPE={kind}"]
    for i, row in enumerate(cells[20:], start=21):
        a, b, c, d = TAGS[row]
        lines += [f"{i}, {a}, {b},", f"{c}, {d}"]
    lines += ["*ELSET, ELSET=part one, GENERATE", "21, 30, 1", "*ELSET, ELSET=skin", "PART ONE,"]
    lines += [", ".join(map(str, range(31, 49)))]
    path.write_text("\n".join(lines) + "\n")


def write_ansys(path: Path, points: np.ndarray, cells: np.ndarray, top: np.ndarray | None = None) -> None:
    """As CDWRITE writes it: shells and solids in one block, components as runs of numbers, a component of nodes."""
    lines = [
        "/COM,ANSYS RELEASE 2024 R1",
        "/PREP7",
        "ET,1,285",
        "ET,2,181",
        f"NBLOCK,6,SOLID,{TAGS.max():9d},{len(TAGS):9d}",
    ]
    lines += ["(3i9,6e21.13e3)"]
    lines += [f"{TAGS[n]:9d}{0:9d}{0:9d}" + "".join(f"{x:21.13E}" for x in points[n]) for n in range(len(TAGS))]
    lines += ["N,R5.3,LOC,       -1,", f"EBLOCK,19,SOLID,{950:9d},{50:9d}", "(19i9)"]

    def row(number: int, kind: int, material: int, nodes: list[int]) -> str:
        return "".join(f"{v:9d}" for v in [material, kind, 1, 1, 0, 0, 0, 0, len(nodes), 0, number, *nodes])

    lines += [row(901 + i, 2, 7, [*TAGS[face], TAGS[face[-1]]]) for i, face in enumerate(skin(cells))]
    lines += [row(1 + i, 1, 1 if i < 20 else 2, list(TAGS[cell])) for i, cell in enumerate(cells)]
    lines += [f"{-1:9d}"]

    def component(name: str, kind: str, numbers: list[int]) -> list[str]:
        rows = ["".join(f"{n:10d}" for n in numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
        return [f"CMBLOCK,{name:<8},{kind},{len(numbers):8d}  ! users element component definition", "(8i10)", *rows]

    lines += component("SOLE", "ELEM", [901, 902])
    lines += component("FAT", "ELEM", [1, -20]) + component("SKIN", "ELEM", [21, -48])
    if top is not None:
        lines += component("TOP", "NODE", sorted(TAGS[top].tolist()))
    path.write_text("\n".join([*lines, "/GO", "FINISH"]) + "\n")


def write_vtk(path: Path, points: np.ndarray, cells: np.ndarray) -> None:
    tissue = [np.array([7, 7]), np.where(np.arange(48) < 20, 1, 2)]
    blocks = [("triangle", skin(cells)), ("tetra", cells)]
    meshio.write(path, meshio.Mesh(points, blocks, cell_data={"tissue": tissue}))


def written(folder: Path, kind: str, scale: float = 1.0, signs: tuple[int, int, int] = (1, 1, 1)) -> Path:
    points, cells = block()
    points = points * scale * signs
    path = folder / f"heel.{kind[:3]}"
    if kind == "inp":
        write_abaqus(path, points, cells)
    elif kind == "cdb":
        write_ansys(path, points, cells)
    elif kind == "msh-22":
        write_gmsh22(path, points, cells)
    elif kind.startswith("msh"):
        write_gmsh41(path, points, cells, binary=kind == "msh-41-binary")
    else:
        write_vtk(path, points, cells)
    return path
