"""Landmark pairs: every way to give them ends in the same points, and what is ambiguous is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dvc.deformation.protocol import Affine, SampledDisplacement
from dvc.errors import ImageFileError, InputError
from dvc.images.image import Grid
from dvc.trust.landmarks import read_landmarks, target_registration_error

NAMES = ("calcaneus", "sesamoid", "septum 4")
X = np.array([[10.5, -20.25, 30.0], [0.0, 4.0, -7.5], [1.0, 2.0, 3.0]])
MOVED = X + np.array([[1.0, 0.0, -2.0], [0.5, 0.25, 0.0], [0.0, -3.0, 4.0]])
SIGNS = {"LPS": np.array([1, 1, 1]), "RAS": np.array([-1, -1, 1])}


def table(path: Path, frame: str = "LPS", header: str = "name,x0,y0,z0,x1,y1,z1") -> Path:
    rows = [header]
    for name, a, b in zip(NAMES, X * SIGNS[frame], MOVED * SIGNS[frame], strict=True):
        numbers = [repr(x) for x in (*a.tolist(), *b.tolist())]
        rows.append(",".join([name, *numbers] if header.startswith("name") else numbers))
    path.write_text("\n".join(rows) + "\n")
    return path


def markups(path: Path, points: np.ndarray, frame: str, names: tuple[str, ...] = NAMES, **more: object) -> Path:
    listed = [
        {"label": name, "position": (p * SIGNS[frame]).tolist(), "positionStatus": "defined"}
        for name, p in zip(names, points, strict=True)
    ]
    markup = {"type": "Fiducial", "coordinateSystem": frame, "coordinateUnits": "mm", "controlPoints": listed}
    path.write_text(json.dumps({"markups": [markup | more]}))
    return path


def fcsv(path: Path, points: np.ndarray, frame: str, word: str | None = None) -> Path:
    lines = ["# Markups fiducial file version = 4.11", f"# CoordinateSystem = {word or frame}"]
    lines += ["# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"]
    for name, (x, y, z) in zip(NAMES, (points * SIGNS[frame]).tolist(), strict=True):
        lines.append(f'1,{x!r},{y!r},{z!r},0,0,0,1,1,1,0,{name},"a, b",')
    path.write_text("\n".join(lines) + "\n")
    return path


def check(read: tuple[np.ndarray, np.ndarray, tuple[str, ...]], names: tuple[str, ...] = NAMES) -> None:
    np.testing.assert_array_equal(read[0], X)
    np.testing.assert_array_equal(read[1], MOVED)
    assert read[2] == names


@pytest.mark.parametrize("frame", ["LPS", "RAS"])
def test_a_table_gives_the_same_points_in_either_frame(tmp_path: Path, frame: str) -> None:
    check(read_landmarks(table(tmp_path / "pairs.csv", frame), frame=frame))


def test_a_table_without_names_counts_from_one_and_its_header_may_be_written_freely(tmp_path: Path) -> None:
    check(read_landmarks(table(tmp_path / "pairs.csv", header="X0, Y0, Z0, x1, y1, z1")), ("1", "2", "3"))


@pytest.mark.parametrize("frames", [("LPS", "LPS"), ("RAS", "LPS"), ("LPS", "RAS"), ("RAS", "RAS")])
def test_two_lists_of_slicer_tell_their_own_frames(tmp_path: Path, frames: tuple[str, str]) -> None:
    pair = markups(tmp_path / "a.mrk.json", X, frames[0]), markups(tmp_path / "b.mrk.json", MOVED, frames[1])
    check(read_landmarks(pair))
    check(read_landmarks((fcsv(tmp_path / "a.fcsv", X, frames[0]), pair[1])))


@pytest.mark.parametrize(("word", "frame"), [("0", "RAS"), ("1", "LPS")])
def test_old_slicer_files_number_their_frame(tmp_path: Path, word: str, frame: str) -> None:
    old = fcsv(tmp_path / "a.fcsv", X, frame, word)
    check(read_landmarks((old, fcsv(tmp_path / "b.fcsv", MOVED, "LPS"))))


def test_lists_are_paired_by_name_whatever_their_order(tmp_path: Path) -> None:
    turned = markups(tmp_path / "b.mrk.json", MOVED[::-1], "LPS", NAMES[::-1])
    check(read_landmarks((markups(tmp_path / "a.mrk.json", X, "LPS"), turned)))


def test_lists_without_a_common_name_are_paired_in_order_and_this_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = markups(tmp_path / "b.mrk.json", MOVED, "LPS", ("F-1", "F-2", "F-3"))
    check(read_landmarks((markups(tmp_path / "a.mrk.json", X, "LPS"), other)))
    assert "have no point name in common; points are paired in the order listed" in caplog.text


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("calcaneus", "sesamoid", "septum 5"), "only in one file: septum 4, septum 5"),
        (("calcaneus", "sesamoid"), r"\(3 points\) and .* \(2 points\) .*only in one file: septum 4"),
        (("calcaneus", "sesamoid", "sesamoid"), "repeated: sesamoid"),
    ],
)
def test_lists_that_match_in_part_are_refused(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    other = markups(tmp_path / "b.mrk.json", MOVED[: len(names)], "LPS", names)
    with pytest.raises(InputError, match=message):
        read_landmarks((markups(tmp_path / "a.mrk.json", X, "LPS"), other))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "column x0 is missing.*it has: nothing"),
        ("x0,y0,z0,x1,y1\n1,2,3,4,5\n", "column z1 is missing.*it has: x0, y0"),
        ("x0,y0,z0,x1,y1,z1\n", "no landmarks below the header line"),
        (
            "x0,y0,z0,x1,y1,z1\n1,2,3,4,5,6\n1,2,3,4,5\n",
            r"pairs\.csv, line 3: the row has 5 cells, but the header has 6",
        ),
        ("x0,y0,z0,x1,y1,z1\n1,2,nan,4,5,6\n", "line 2: z0 must be a finite number"),
        ("x0;y0;z0;x1;y1;z1\n1;2;3;4;5;6\n", "separated by semicolons"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_landmarks(tmp_path / "pairs.csv")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"coordinateSystem": "IJK"}, "in mm, LPS or RAS; the file gives IJK"),
        ({"coordinateUnits": "m"}, "the file gives LPS, m"),
        ({"controlPoints": []}, "the list has no points"),
        ({"controlPoints": [{"label": "a", "position": [1, 2]}]}, "'a' has no position"),
        ({"controlPoints": [{"label": "a", "position": [1, 2, None]}]}, "'a': position must be"),
        ({"controlPoints": [{"label": "a", "positionStatus": "undefined"}]}, "'a' was never placed"),
        ({"controlPoints": None}, "not a Slicer file with one point list"),
    ],
)
def test_a_damaged_list_of_slicer_is_refused(tmp_path: Path, more: dict[str, object], message: str) -> None:
    good = markups(tmp_path / "a.mrk.json", X, "LPS")
    with pytest.raises(ImageFileError, match=message):
        read_landmarks((good, markups(tmp_path / "b.mrk.json", X, "LPS", **more)))


def test_what_tells_no_frame_or_is_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    good = fcsv(tmp_path / "a.fcsv", X, "LPS")
    (tmp_path / "bare.fcsv").write_text("1,2,3,4\n")
    (tmp_path / "cut.mrk.json").write_text('{"markups": [')
    with pytest.raises(ImageFileError, match="lacks the frame"):
        read_landmarks((good, tmp_path / "bare.fcsv"))
    with pytest.raises(ImageFileError, match="lacks the frame"):
        read_landmarks((good, fcsv(tmp_path / "ijk.fcsv", X, "LPS", "IJK")))
    with pytest.raises(ImageFileError, match="not a Slicer file"):
        read_landmarks((good, tmp_path / "cut.mrk.json"))
    with pytest.raises(InputError, match=r"must end in \.mrk\.json or \.fcsv"):
        read_landmarks((good, tmp_path / "points.txt"))
    with pytest.raises(InputError, match="two point lists"):
        read_landmarks(good)
    with pytest.raises(InputError, match="LPS or RAS; got 'ijk'"):
        read_landmarks(tmp_path / "pairs.csv", frame="ijk")
    with pytest.raises(InputError, match="cannot be read"):
        read_landmarks(tmp_path / "missing.csv")


def test_a_list_of_slicer_that_is_cut_in_a_line_is_refused(tmp_path: Path) -> None:
    path = fcsv(tmp_path / "a.fcsv", X, "LPS")
    text = path.read_text().removesuffix("\n")
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.fcsv: the file may be incomplete: it ends in the middle of a line"):
        read_landmarks((path, path))
    path.write_text(text.rpartition(",")[0] + "\n")
    with pytest.raises(ImageFileError, match=r"a\.fcsv, line 6: the row has 13 of 14 columns. Save the list again"):
        read_landmarks((path, path))


def test_the_error_is_the_distance_between_prediction_and_landmark() -> None:
    F = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.0], [0.1, 0.0, 1.0]])
    motion = Affine(F, np.array([3.0, -1.0, 2.0]))
    x = motion.apply(X)
    np.testing.assert_allclose(target_registration_error(motion, X, x), 0.0, atol=1e-12)
    np.testing.assert_allclose(target_registration_error(motion, X, x + np.array([3.0, 0.0, -4.0])), 5.0, rtol=1e-12)


def test_a_landmark_outside_the_measured_field_has_no_error_not_a_zero_one() -> None:
    field = SampledDisplacement(Grid((4, 4, 4), np.ones(3), np.zeros(3)), np.zeros((4, 4, 4, 3)))
    points = np.array([[1.0, 1.0, 1.0], [9.0, 1.0, 1.0]])
    error = target_registration_error(field, points, points)
    assert error[0] == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(error[1])
    with pytest.raises(InputError, match=r"got \(2, 3\) and \(1, 3\)"):
        target_registration_error(field, points, points[:1])
