"""Arguments are refused by their names where they are of another kind than their annotations say."""

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, get_origin

import numpy as np
import pytest

import dvc
import fe
import phantoms
from dvc.arguments import check, checked
from dvc.arrays import FloatArray, as_points
from dvc.deformation.nodal import OnMesh
from dvc.errors import InputError
from tests.fe.test_simulation import dome

GRID = dvc.Grid((3, 3, 3), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
IMAGE = dvc.Image(GRID, np.arange(27.0).reshape(3, 3, 3))
MASK = dvc.Mask(GRID, IMAGE.values > 9)
LABELS = dvc.LabelMap(GRID, MASK.inside.astype(int), {1: "bone"})


@checked
def takes(
    image: dvc.Image, number: float = 1.0, count: int = 1, names: Sequence[str] = (),
    pair: tuple[str, float] | None = None,
    by_name: Mapping[str, dvc.Mask] | None = None, file: Path | str = "a", values: FloatArray | None = None,
) -> str:  # fmt: skip
    """Do nothing."""
    return "taken"


@pytest.mark.parametrize(
    "given",
    [
        {"number": 2, "count": np.int64(3), "names": np.array(["a"]), "pair": ("a", 1), "by_name": {"a": MASK}},
        {"number": np.float32(2), "names": {"a": 1}.keys(), "file": Path("a"), "values": [1.0, 2.0]},
    ],
)
def test_what_fits_is_taken(given: dict[str, Any]) -> None:
    assert takes(IMAGE, **given) == "taken"
    assert takes.__doc__ == "Do nothing."


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"image": "a.nii"}, r"^image must be a dvc\.Image, .*read_image.*; got 'a\.nii'\.$"),
        ({"image": IMAGE.values}, r"^image must be .*; got ndarray of shape \(3, 3, 3\)\.$"),
        ({"number": "2"}, "^number must be a number; got '2'"),
        ({"count": 1.5}, "^count must be a whole number; got 1.5"),
        ({"names": "bone"}, "^names must be a list, each item text .*; got 'bone'"),
        ({"names": ["a", 3]}, r"^names\[1\] must be text \(str\); got 3"),
        ({"pair": ("a", "b")}, r"^pair\[1\] must be a number; got 'b'"),
        ({"pair": ("a", 1.0, 2.0)}, r"^pair must be \(text \(str\), a number\); got tuple"),
        ({"by_name": {"a": IMAGE}}, r"^by_name\['a'\] must be a dvc\.Mask.*; got Image"),
        ({"by_name": [MASK]}, "^by_name must be a dict, each value a dvc.Mask.*; got list"),
        ({"file": 3}, "^file must be the path of a file or folder .*; got 3"),
        ({"values": "z"}, "^values must be an array of numbers; got 'z'"),
    ],
)
def test_what_does_not_fit_is_named_with_what_is_wanted(given: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        takes(**{"image": IMAGE, **given})


MEASURE: list[tuple[dict[str, Any], str]] = [
    ({"reference": IMAGE.values}, "^reference must be a dvc.Image"),
    ({"bone": LABELS}, "^bone must be a dvc.Mask.*; got LabelMap"),
    ({"labels": MASK}, "^labels must be a dvc.LabelMap.*; got Mask"),
    ({"settings": dvc.GaussNewton()}, "^settings must be a dvc.Settings.*; got GaussNewton"),
    ({"repeat": "Load0-again.nii.gz"}, "^repeat must be a dvc.Image.*; got 'Load0-again"),
    ({"start": "u.nii.gz"}, "^start must be a deformation.*; got 'u.nii.gz'"),
    ({"error_model": "em.json"}, "^error_model must be a dvc.ErrorModel.*; got 'em.json'"),
    ({"landmarks": "lm.csv"}, "^landmarks must be .*; got 'lm.csv'"),
    ({"plate_normal": "z"}, "^plate_normal must be a list, each item a number; got 'z'"),
    ({"mesh": dome((2, 3, 3))}, "^mesh must be a dvc.MeshFile.*; got TetMesh"),
]


@pytest.mark.parametrize(
    ("given", "told"), MEASURE, ids=lambda value: next(iter(value)) if isinstance(value, dict) else ""
)
def test_measure_refuses_before_anything_is_registered(given: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        dvc.measure(**{"reference": IMAGE, "loaded": IMAGE, "bone": MASK, **given})


class PathOfLoads:
    """Not the path of a file, whatever its name says."""


@pytest.mark.parametrize("hint", [Path, str | PathLike[str], Sequence[str | Path], Mapping[str, Path | str | None]])
def test_text_with_a_null_character_is_no_path(hint: Any) -> None:
    value: Any = {Sequence: ["a\0"], Mapping: {"a": "a\0"}}.get(get_origin(hint), Path("a\0"))
    with pytest.raises(InputError, match="null character"):
        check("file", value, hint)
    check("load", "a\0", str | PathOfLoads)


def test_others_refuse_as_well() -> None:
    plate, load = fe.Plate((0, 0, -1), (0, -1, 0)), fe.LoadStep("a", normal_n=2.0)
    for call, told in (
        (lambda: dvc.Settings.of("gauss-newton", threads="2"), "threads must be a whole number; got '2'"),
        (lambda: dvc.GaussNewton(bending="3"), "bending must be a number; got '3'"),
        (lambda: dvc.Image(IMAGE.values, GRID), "grid must be a dvc.Grid"),
        (lambda: dvc.Image(GRID, "a.nii"), "An array of numbers is needed; got 'a.nii'"),
        (lambda: phantoms.heel_pair((34, 38, 36), 3.0), "seed must be a whole number; got tuple"),
        (lambda: phantoms.heel_pair(1, (34, 38, 36), 0.003), "between 0.05 and 20 mm; got 0.003"),
        (lambda: phantoms.heel_pair(motion="sliding"), "motion must be .*; got 'sliding'"),
        (lambda: fe.LoadStep(2.0, "p"), "name must be text .*; got 2.0"),
        (lambda: fe.LoadStep("p", normal_n="2"), "normal_n must be a number; got '2'"),
        (lambda: fe.Plate("-x", (0, 1, 0)), "An array of numbers is needed; got '-x'"),
        (lambda: fe.Ogden.from_abaqus("a", 6.2), "An array of numbers is needed"),
        (lambda: fe.mesh_labels(LABELS, "5"), "edge_mm must be a number; got '5'"),
        (lambda: fe.mesh_labels("a.nii", 5.0), "labels must be a dvc.LabelMap.*; got 'a.nii'"),
        (lambda: fe.mesh_labels(LABELS, 5.0, bones="bone"), "bones must be a list.*; got 'bone'"),
        (lambda: fe.write_tet_mesh(dome((2, 3, 3)), "b.vtu"), "path must be the path.*; got TetMesh"),
        (lambda: fe.write_tet_mesh("b.xyz", dome((2, 3, 3))), r"must end in \.vtu"),
        (lambda: fe.simulate(dome((2, 3, 3)), "trebbi", plate, [load], fixed="bone"), "fixed must be a list.*'bone'"),
        (lambda: fe.simulate(dome((2, 3, 3)), "trebbi", plate, [load], options={}), "options must be a fe.SolverOpt"),
    ):  # fmt: skip
        with pytest.raises(dvc.errors.MrstrainError, match=told):
            call()


@pytest.mark.parametrize("shape", [(3,), (4, 2), (4, 4), (2, 2, 3)])
def test_points_have_three_coordinates_each(shape: tuple[int, ...]) -> None:
    points = np.ones(shape)
    mesh = dome((2, 3, 3))
    spline = dvc.BSpline(dvc.Grid((6, 6, 6), (1.0,) * 3, (0.0,) * 3), np.zeros((3, 6, 6, 6)))
    for deformation in (OnMesh(mesh, np.zeros_like(mesh.points_mm)), spline, dvc.Affine(np.eye(3), np.zeros(3))):
        for evaluate in (deformation.evaluate, deformation.displacement):
            with pytest.raises(InputError, match=r"Points must be an array \(n, 3\), LPS mm; got shape"):
                evaluate(points)
    with pytest.raises(InputError, match="One point:"):
        as_points(points)


def test_labels_are_no_mask_and_grey_values_no_labels() -> None:
    numbers = np.arange(27).reshape(3, 3, 3)
    with pytest.raises(InputError, match=r"these are labels\. Select one"):
        dvc.Mask(GRID, numbers)
    assert dvc.Mask(GRID, numbers % 2).inside.sum() == 13
    with pytest.raises(InputError, match="Labels must be whole numbers"):
        dvc.LabelMap(GRID, LABELS.labels + 0.7, {1: "bone"})
    assert dvc.LabelMap(GRID, LABELS.labels.astype(float), {1: "bone"}).labels.dtype == np.int64


def test_what_lies_on_a_grid_is_shown_in_a_line() -> None:
    grid = f"grid=Grid({GRID})"
    assert repr(IMAGE) == f"Image({grid})"
    assert repr(MASK) == f"Mask({grid})"
    assert repr(LABELS) == f"LabelMap({grid}, names={{1: 'bone'}})"
    assert repr(GRID) == f"Grid({GRID})"


def test_a_type_variable_takes_what_it_may_stand_for() -> None:
    """NumPy 2.5 has some without limits in its ArrayLike, which was an error of typing's own."""
    free, bound, either = TypeVar("free"), TypeVar("bound", bound=dvc.Mask), TypeVar("either", dvc.Mask, dvc.Image)
    check("it", "anything", free)
    check("it", MASK, bound)
    check("it", IMAGE, either)
    for hint in (bound, either):
        with pytest.raises(InputError, match=r"^it must be .*dvc\.Mask.*; got LabelMap"):
            check("it", LABELS, hint)
