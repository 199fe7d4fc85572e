"""An argument of another kind than is needed is refused by its name, with what was passed and what is wanted."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dvc
from dvc.errors import InputError

GRID = dvc.Grid((5, 5, 5), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
ARRAY = np.arange(125.0).reshape(GRID.shape)
IMAGE, MASK = dvc.Image(GRID, ARRAY), dvc.Mask(GRID, ARRAY > 9)
LABELS = dvc.LabelMap(GRID, ARRAY > 9, {1: "fat"})
VECTORS = np.zeros((*GRID.shape, 3))
READERS = [dvc.read_image, dvc.read_mask, dvc.read_labels, dvc.read_mesh, dvc.read_transform, dvc.read_displacement]


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (ARRAY, r"ndarray of shape \(5, 5, 5\)"),
        (None, "None"),
        (IMAGE, "Image"),
        (5, "5"),
        (["a"], "list"),
        (b"a", "bytes"),
    ],
)
@pytest.mark.parametrize("read", READERS, ids=lambda read: read.__name__)
def test_what_is_read_has_a_path(read: Callable[[Any], object], value: object, told: str) -> None:
    with pytest.raises(InputError, match=rf"^path must be the path of a file or folder \(str or .*\); got {told}\.$"):
        read(value)


@pytest.mark.parametrize("value", [ARRAY, None, Path("a.nii"), GRID])
@pytest.mark.parametrize("kind", ["image", "mask", "labels"])
def test_what_is_written_is_of_the_writers_kind(tmp_path: Path, kind: str, value: object) -> None:
    made = {"image": IMAGE, "mask": MASK, "labels": LABELS}
    write = getattr(dvc, f"write_{kind}")
    for other in [value, *(thing for name, thing in made.items() if name != kind)]:
        with pytest.raises(InputError, match=rf"^{kind} must be a dvc\.\w+, .*; got "):
            write(tmp_path / "a.nii", other)
    with pytest.raises(InputError, match=rf"^path must be the path .*; got {type(made[kind]).__name__}"):
        write(made[kind], tmp_path / "a.nii")
    with pytest.raises(InputError, match=r"^path must be .*; got None"):
        write(None, made[kind])
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"path": IMAGE}, "^path must be .*; got Image"),
        ({"grid": IMAGE}, "^grid must be a dvc.Grid, .*; got Image"),
        ({"components": 3}, "^components must be .*; got 3"),
        ({"values": VECTORS * 1j}, "^values must be real numbers; got complex128"),
        ({"values": VECTORS.astype(str)}, "^values must be real numbers; got <U"),
        ({"verdict": "trust"}, "^verdict must be a dvc.Verdict; got 'trust'"),
    ],
)
def test_vectors_are_numbers_on_a_grid(tmp_path: Path, change: dict[str, Any], told: str) -> None:
    given = {"path": tmp_path / "u.nii", "grid": GRID, "values": VECTORS, "components": ("x", "y", "z"), "meaning": "u"}
    with pytest.raises(InputError, match=told):
        dvc.write_vectors(**{**given, **change}, unit="mm")
    assert not any(tmp_path.iterdir())


def test_options_of_readers_are_of_their_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.nii"
    dvc.write_labels(path, LABELS)
    for grid, told in ((IMAGE, "Image"), (path, r"PosixPath\(.*\)|WindowsPath\(.*\)"), (ARRAY, "ndarray")):
        with pytest.raises(InputError, match=rf"^grid must be a dvc\.Grid, .*image\.grid.*; got ({told})"):
            dvc.read_mask(path, grid)
        with pytest.raises(InputError, match=rf"^grid must be a dvc\.Grid, .*image\.grid.*; got ({told})"):
            dvc.fit_mask(MASK, grid)
    for mask in (ARRAY, path, IMAGE, None):
        with pytest.raises(InputError, match=r"^mask_or_labels must be a dvc\.Mask, .*, or a dvc\.LabelMap, .*; got "):
            dvc.fit_mask(mask, GRID)
    for names in (5, ["fat"], GRID):
        with pytest.raises(InputError, match=r"^names must be a dict, .*, or the path of .*; got "):
            dvc.read_labels(path, names)
    for name, value in (("volume", "0"), ("volume", 0.5), ("max_bytes", "5"), ("series", 5)):
        with pytest.raises(InputError, match=rf"^{name} must be .*; got {value!r}\.$"):
            dvc.read_image(path, **{name: value})
    with pytest.raises(InputError, match=r"^frame must be text .*; got list"):
        dvc.read_displacement(path, frame=["LPS"])
    for name in ("unit", "frame"):
        with pytest.raises(InputError, match=rf"^{name} must be text .*; got list"):
            dvc.read_mesh(path.with_suffix(".vtu"), **{name: ["mm"]})
