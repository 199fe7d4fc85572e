"""FEBio's plot files, written here by the documented layout (there is no FEBio to run)."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.io.meshes.read import read_mesh
from tests.meshfiles import block, skin
from tests.validate.test_quadratic_cells import quadratic, reference
from validate import read_result


def chunk(tag: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack("<II", tag, len(body)) + body


def whole(tag: int, number: int) -> bytes:
    return chunk(tag, struct.pack("<i", number))


def text(tag: int, words: str) -> bytes:
    return chunk(tag, words.encode().ljust(64, b"\0"))


def floats(tag: int, values: np.ndarray) -> bytes:
    return chunk(tag, values.astype("<f4").tobytes())


def domain(kind: int, part: int, cells: np.ndarray) -> bytes:
    head = chunk(0x01042101, whole(0x01042102, kind), whole(0x01042103, part), whole(0x01032104, len(cells)))
    rows = [chunk(0x01042201, struct.pack(f"<{len(c) + 1}i", n, *c)) for n, c in enumerate(cells.tolist(), start=1)]
    return chunk(0x01042100, head, chunk(0x01042200, *rows))


def sections(
    points: np.ndarray, domains: list[bytes], u: np.ndarray, packed: bool = False, variable: str = "displacement",
    times: tuple[float, ...] = (0.5, 1.0), status: int = 0,
) -> list[bytes]:  # fmt: skip
    """Root, mesh of two parts, states of which the last counts; a nodal variable stands before the displacement."""
    items = [chunk(0x01020001, whole(0x01020002, 1), whole(0x01020003, 0), text(0x01020004, name))
             for name in ("velocity", variable)]  # fmt: skip
    header = chunk(0x01010000, whole(0x01010001, 0x0035), whole(0x01010004, int(packed)))
    root = chunk(0x01000000, header, chunk(0x01020000, chunk(0x01023000, *items)))
    nodes = np.zeros(len(points), dtype=[("id", "<i4"), ("x", "<f4", 3)])
    nodes["id"], nodes["x"] = 100 + 2 * np.arange(len(points)), points
    node_part = chunk(0x01041000, chunk(0x01041100, whole(0x01041101, len(points)), whole(0x01041102, 3)),
                      chunk(0x01041200, nodes.tobytes()))  # fmt: skip
    parts = [chunk(0x01045100, whole(0x01045101, n), text(0x01045102, name)) for n, name in ((1, "fat"), (2, "skin"))]
    mesh = chunk(0x01040000, node_part, chunk(0x01042000, *domains), chunk(0x01045000, *parts))
    states = []
    for time in times:
        values = [chunk(0x02020001, whole(0x02020002, n), chunk(0x02020003, floats(0, field)))
                  for n, field in ((1, 9.0 * u), (2, time * u))]  # fmt: skip
        state = chunk(0x02000000, chunk(0x02010000, floats(0x02010002, np.array([time])), whole(0x02010003, status)),
                      chunk(0x02020000, chunk(0x02020300, *values)))  # fmt: skip
        states.append(zlib.compress(state) if packed else state)
    return [struct.pack("<I", 0x00464542) + root, mesh, *states]


def write_xplt(path: Path, *what: object, **how: object) -> Path:
    path.write_bytes(b"".join(sections(*what, **how)))
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_tetrahedra_of_two_parts_and_a_shell(tmp_path: Path, packed: bool) -> None:
    points, cells = block()
    u = 0.01 * points[:, [1, 2, 0]]
    domains = [
        domain(2, 1, cells[:20]),
        domain(4, 2, skin(cells)),
        domain(5, 2, cells[:3, :2]),
        domain(2, 2, cells[20:]),
    ]
    path = write_xplt(tmp_path / "Load1.xplt", points, domains, u, packed=packed)
    mesh = read_mesh(path)
    assert [b.kind for b in mesh.blocks] == ["tetra", "triangle", "tetra"]
    assert {name: len(found) for name, found in mesh.regions.items()} == {"fat": 20, "skin": 30}
    assert mesh.node_ids[:3].tolist() == [100, 102, 104]
    result = read_result("febio", path)
    np.testing.assert_allclose(result.deformation.u_mm, u, atol=1e-6)
    assert {name: len(found) for name, found in result.mesh.regions.items()} == {"fat": 20, "skin": 28}


def test_a_file_whose_last_state_is_the_unloaded_one_is_no_result(tmp_path: Path) -> None:
    points, cells = block()
    path = write_xplt(tmp_path / "Load1.xplt", points, [domain(2, 1, cells)], 0.01 * points, times=(0.0,))
    assert read_mesh(path).tets is not None  # as a mesh it serves
    with pytest.raises(InputError, match=r"is 0 everywhere, as at time 0.*FEBio's log.*PLOT_MAJOR_ITRS"):
        read_result("febio", path)


@pytest.mark.parametrize(
    ("times", "status", "words"),
    [
        ((0.0, 0.5, 1.0), 0, []),
        ((0.0, 2.0), 2, []),  # of a run whose last state alone is written (PLOT_FINAL, plot_stride)
        ((0.0, 1.0, 1.0), 2, ["written in every iteration (PLOT_MINOR_ITRS)"]),
    ],
)
def test_a_last_state_that_may_not_be_converged_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, times: tuple[float, ...], status: int, words: list[str]
) -> None:
    points, cells = block()
    how = {"times": times, "status": status}
    read_mesh(write_xplt(tmp_path / "Load1.xplt", points, [domain(2, 1, cells)], 0.01 * points, **how))
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len(said) == len(words)
    assert all(word in one for word, one in zip(words, said, strict=True))


@pytest.mark.parametrize(("number", "kind"), [(6, "hexahedron20"), (9, "hexahedron27"), (13, "wedge15")])
def test_quadratic_elements(tmp_path: Path, number: int, kind: str) -> None:
    points = 10.0 * reference(kind) + 5.0
    if kind == "hexahedron27":  # FEBio lists the faces y-, x+, y+, x-, and then z-, z+
        points = points[[*range(20), 22, 21, 23, 20, 24, 25, 26]]
    path = write_xplt(
        tmp_path / "Load1.xplt", points, [domain(number, 1, np.arange(len(points))[None])], quadratic(points)
    )
    result = read_result("febio", path)
    assert np.abs(result.deformation.u_mm - quadratic(result.mesh.points_mm)).max() < 1e-4
    assert len(result.mesh.cells) == {"hexahedron20": 48, "hexahedron27": 48, "wedge15": 32}[kind]


def test_a_folded_element_is_refused_with_its_file(tmp_path: Path) -> None:
    points = 10.0 * reference("hexahedron20")[:8]
    path = write_xplt(tmp_path / "Load1.xplt", points, [domain(0, 1, np.array([[0, 1, 2, 3, 4, 5, 6, 3]]))], points)
    with pytest.raises(GeometryError, match=r"Load1\.xplt: 1 hexahedron cells are folded"):
        read_result("febio", path)


def test_what_is_damaged_or_another_is_refused(tmp_path: Path) -> None:
    points, cells = block()
    u = 0.01 * points
    path = tmp_path / "Load1.xplt"
    with pytest.raises(InputError, match=r'no displacement at its nodes.*<var type="displacement"/>'):
        read_result("febio", write_xplt(path, points, [domain(2, 1, cells)], u, variable="position"))
    with pytest.raises(ImageFileError, match="FEBio type 14"):
        read_mesh(write_xplt(path, points, [domain(14, 1, cells)], u))
    for packed in (False, True):
        root, mesh, *states = sections(points, [domain(2, 1, cells)], u, packed=packed)
        data = b"".join([root, mesh, *states])
        after = len(root) + len(mesh)
        full = {after + len(states[0])}  # a run that was ended after its first state is whole
        for end in {*range(0, len(data), len(data) // 40), after, len(data) - 1} - full:
            path.write_bytes(data[:end])
            with pytest.raises((ImageFileError, InputError)):
                read_result("febio", path)
        path.write_bytes(data + mesh)
        with pytest.raises(ImageFileError, match="remeshing"):
            read_mesh(path)
    path.write_bytes(b"anything else")
    with pytest.raises(ImageFileError, match="not a FEBio plot file"):
        read_mesh(path)
