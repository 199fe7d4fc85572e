"""NRRD and MetaImage headers: spaces, units, encodings, and what is refused."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from dvc.errors import ImageFileError
from dvc.io.images.read import read_image

_VALUES = np.random.default_rng(8).integers(0, 1000, (5, 6, 7)).astype(np.int16)
_NRRD = {
    "type": "short",
    "dimension": "3",
    "space": "left-posterior-superior",
    "sizes": "5 6 7",
    "space directions": "(0,1.5,0) (2,0,0) (0,0,-1)",
    "kinds": "domain domain domain",
    "endian": "little",
    "encoding": "raw",
    "space origin": "(10,-20,30)",
}
_META = {
    "ObjectType": "Image",
    "NDims": "3",
    "BinaryData": "True",
    "BinaryDataByteOrderMSB": "False",
    "CompressedData": "False",
    "TransformMatrix": "0 1 0 1 0 0 0 0 -1",
    "Offset": "10 -20 30",
    "ElementSpacing": "1.5 2 1",
    "DimSize": "5 6 7",
    "ElementType": "MET_SHORT",
    "ElementDataFile": "LOCAL",
}


def _stored(dtype: str = "<i2") -> bytes:
    return _VALUES.astype(dtype).tobytes(order="F")


def _nrrd(path: Path, data: bytes | None = None, newline: str = "\n", **fields: str | None) -> Path:
    changed = {name.replace("_", " "): value for name, value in fields.items()}
    lines = [f"{name}: {value}" for name, value in (_NRRD | changed).items() if value is not None]
    header = newline.join(["NRRD0004", "# by hand", *lines, "", ""])
    path.write_bytes(header.encode() + (_stored() if data is None else data))
    return path


def _meta(path: Path, data: bytes | None = None, **fields: str | None) -> Path:
    changed = _META | fields
    changed["ElementDataFile"] = changed.pop("ElementDataFile")  # it ends the header
    lines = [f"{name} = {value}" for name, value in changed.items() if value is not None]
    path.write_bytes(("\n".join(lines) + "\n").encode() + (_stored() if data is None else data))
    return path


@pytest.mark.parametrize("write", [_nrrd, _meta])
def test_axes_are_read_as_simpleitk_reads_them(tmp_path: Path, write: object) -> None:
    path = tmp_path / ("a.nrrd" if write is _nrrd else "a.mha")
    image = read_image(write(path))  # type: ignore[operator]
    np.testing.assert_array_equal(image.values, _VALUES)
    np.testing.assert_allclose(image.grid.affine[:3, :3], [[0, 2, 0], [1.5, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(image.grid.origin_mm, [10, -20, 30])
    other = sitk.ReadImage(str(path))
    np.testing.assert_allclose(other.GetDirection(), image.grid.direction.ravel())


@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("left-posterior-superior", (1, 1, 1)),
        ("LPS", (1, 1, 1)),
        ("RAS", (-1, -1, 1)),
        ("right-anterior-superior", (-1, -1, 1)),
        ("LAS", (1, -1, 1)),
        ("left-anterior-superior", (1, -1, 1)),
    ],
)
def test_named_spaces_are_brought_to_lps(tmp_path: Path, space: str, signs: tuple[int, ...]) -> None:
    path = _nrrd(tmp_path / "a.nrrd", space=space)
    grid = read_image(path).grid
    np.testing.assert_allclose(grid.origin_mm, np.array([10, -20, 30]) * signs)
    np.testing.assert_allclose(grid.affine[:3, :3], np.diag(signs) @ [[0, 2, 0], [1.5, 0, 0], [0, 0, -1]])
    other = sitk.ReadImage(str(path))
    np.testing.assert_allclose(other.GetOrigin(), grid.origin_mm)
    np.testing.assert_allclose(other.GetDirection(), grid.direction.ravel(), atol=1e-12)


@pytest.mark.parametrize("space", [None, "scanner-xyz", "3D-right-handed", "left-posterior-superior-time"])
def test_a_space_that_is_not_the_body_s_is_refused(tmp_path: Path, space: str | None) -> None:
    with pytest.raises(ImageFileError, match="has no supported orientation"):
        read_image(_nrrd(tmp_path / "a.nrrd", space=space))


def test_spacings_without_directions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageFileError, match="has no supported orientation"):
        read_image(_nrrd(tmp_path / "a.nrrd", space_directions=None, spacings="1 1 1"))


@pytest.mark.parametrize(("unit", "factor"), [("m", 1000.0), ("um", 0.001), ("cm", 10.0)])
def test_other_units_are_converted_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, unit: str, factor: float
) -> None:
    x, y, z = (f"{number / factor:g}" for number in (1.5, 2.0, 1.0))
    for path in (
        _nrrd(
            tmp_path / "a.nrrd", space_units=f'"{unit}" "{unit}" "{unit}"',
            space_directions=f"(0,{x},0) ({y},0,0) (0,0,-{z})",
        ),
        _meta(tmp_path / "a.mha", DistanceUnits=unit, ElementSpacing=f"{x} {y} {z}"),
    ):  # fmt: skip
        caplog.clear()
        grid = read_image(path).grid
        np.testing.assert_allclose(grid.spacing_mm, [1.5, 2.0, 1.0])
        np.testing.assert_allclose(grid.origin_mm, np.array([10, -20, 30]) * factor)
        assert f"converted from {unit} to mm" in caplog.text


def test_units_that_mean_nothing_here_are_refused(tmp_path: Path) -> None:
    for units in ('"inch" "inch" "inch"', '"mm" "mm" "m"'):
        with pytest.raises(ImageFileError, match="lengths are in"):
            read_image(_nrrd(tmp_path / "a.nrrd", space_units=units))


@pytest.mark.parametrize(
    ("dtype", "kind", "element"),
    [
        ("u1", "uchar", "MET_UCHAR"),
        ("i1", "signed char", "MET_CHAR"),
        ("i2", "int16_t", "MET_SHORT"),
        ("u2", "unsigned short", "MET_USHORT"),
        ("i4", "int", "MET_INT"),
        ("u4", "unsigned int", "MET_UINT"),
        ("i8", "long long int", "MET_LONG_LONG"),
        ("f4", "float", "MET_FLOAT"),
        ("f8", "double", "MET_DOUBLE"),
    ],
)
@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("compressed", [False, True])
def test_number_types_byte_orders_and_compression(
    tmp_path: Path, dtype: str, kind: str, element: str, order: str, compressed: bool
) -> None:
    sign = ">" if order == "big" else "<"
    expected = _VALUES.astype(dtype)
    raw = expected.astype(sign + dtype).tobytes(order="F")
    coding = "gzip" if compressed else "raw"
    data = gzip.compress(raw) if compressed else raw
    nrrd = _nrrd(tmp_path / "a.nrrd", data, type=kind, endian=order, encoding=coding)
    np.testing.assert_array_equal(read_image(nrrd).values, expected)
    meta = _meta(
        tmp_path / "a.mha",
        zlib.compress(raw) if compressed else raw,
        ElementType=element,
        BinaryDataByteOrderMSB=str(order == "big"),
        CompressedData=str(compressed),
    )
    np.testing.assert_array_equal(read_image(meta).values, expected)


def test_headers_with_carriage_returns_are_read(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read_image(_nrrd(tmp_path / "a.nrrd", newline="\r\n")).values, _VALUES)


@pytest.mark.parametrize("axis", ["first", "last"])
def test_a_volume_of_a_4d_nrrd(tmp_path: Path, axis: str) -> None:
    stack = np.stack([_VALUES, _VALUES + 1000, _VALUES * 3], axis=0 if axis == "first" else 3)
    directions = _NRRD["space directions"]
    path = _nrrd(
        tmp_path / "a.nrrd",
        stack.astype("<i2").tobytes(order="F"),
        dimension="4",
        sizes="3 5 6 7" if axis == "first" else "5 6 7 3",
        space_directions=f"none {directions}" if axis == "first" else f"{directions} none",
        kinds="list domain domain domain" if axis == "first" else "domain domain domain list",
    )
    with pytest.raises(ImageFileError, match="contains 3 volumes"):
        read_image(path)
    np.testing.assert_array_equal(read_image(path, volume=2).values, _VALUES * 3)


def test_vectors_and_colours_are_refused(tmp_path: Path) -> None:
    data = bytes(2 * 3 * 5 * 6 * 7)
    for kind in ("vector", "3-color", "RGB-color", "3-gradient"):
        path = _nrrd(
            tmp_path / "a.nrrd",
            data,
            dimension="4",
            sizes="3 5 6 7",
            space_directions=f"none {_NRRD['space directions']}",
            kinds=f"{kind} domain domain domain",
        )
        with pytest.raises(ImageFileError, match="each voxel holds 3 values"):
            read_image(path)
    with pytest.raises(ImageFileError, match="each voxel holds 3 values"):
        read_image(_meta(tmp_path / "a.mha", data, ElementNumberOfChannels="3"))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"space directions": "(0,1.5,0) (2,1,0) (0,0,-1)"}, "sheared"),
        ({"space directions": "(0,0,0) (2,0,0) (0,0,-1)"}, "must be positive"),
        ({"space directions": "(0,x,0) (2,0,0) (0,0,-1)"}, "not a vector"),
        ({"space directions": "(0,1) (2,0) (0,0)"}, "not a vector"),
        ({"space directions": "(0,1.5,0) (2,0,0)"}, "3 sizes and 2 space directions"),
        ({"space origin": None}, "'space origin' is missing"),
        ({"sizes": None}, "'sizes' is missing"),
        ({"sizes": "5 -6 7"}, "must be positive"),
        ({"sizes": "900000 900000 900000"}, r"about 2,\d+,\d+,\d+\.\d GiB"),
        ({"type": "block"}, "NRRD type 'block' is not supported"),
        ({"endian": None}, "byte order"),
        ({"encoding": "ascii"}, "encoding 'ascii' is not supported"),
        ({"encoding": "bzip2"}, "encoding 'bzip2' is not supported"),
        ({"byte skip": "-1"}, "skip"),
        ({"data file": "elsewhere.raw"}, "'elsewhere.raw', is missing"),
        ({"data file": "slice%03d.raw 1 7 1"}, "several files"),
        ({"dimension": "2", "sizes": "5 6"}, "2D image"),
        ({"sizes": "5 nan 7"}, "'sizes' is missing or not"),
        ({"sizes": "inf 6 7"}, "'sizes' is missing or not"),
        ({"sizes": "5.5 6 7"}, "'sizes' must be whole numbers"),
        ({"space origin": "(10,-20)"}, "'space origin' is missing or not"),
        ({"space directions": "(0,1e200,0) (2,0,0) (0,0,-1)"}, "must be positive"),
        ({"space origin": "(10,-20,3_0)"}, r"not a vector .*3_0"),
        ({"space origin": "(10,nan,30)"}, r"not a vector .*nan"),
        ({"data file": "a" * 300}, "is missing"),
        ({"space origin": "510,-20,30)"}, r"'space origin' is missing or not a vector .*'510,-20,30\)'"),
        ({"space origin": "(10,-20,3"}, "'space origin' is missing or not a vector"),
        ({"space directions": "(0,1.5,0) (2,0,0) (0,,0,-1)"}, "'space directions' is missing or not a vector"),
        ({"space directions": "(0,1.5,0) (2,0,0) (0,0,-1)1"}, "'space directions' are not vectors"),
        ({"space units": '#cm" "cm" "cm"'}, "'space units' are not quoted words"),
        ({"dimension": None}, "'dimension' is missing"),
        ({"dimension": "1"}, "3 sizes, 1 dimensions"),
        ({"endian": "litle"}, "is 'litle', neither little nor big"),
        ({"space units": '"mm" "mm"\n"mm"'}, "the NRRD header is damaged; this line is not a field: '\"mm\"'"),
    ],
    ids=str,
)
def test_nrrd_headers_that_are_refused(tmp_path: Path, fields: dict[str, str | None], message: str) -> None:
    with pytest.raises(ImageFileError, match=message):
        read_image(_nrrd(tmp_path / "a.nrrd", **fields))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"TransformMatrix": "1 0.2 0 0 1 0 0 0 1"}, "sheared|perpendicular"),
        ({"TransformMatrix": "1 0 0 1"}, "'TransformMatrix' is missing or not"),
        ({"ElementSpacing": "1 0 1"}, "must be positive"),
        ({"DimSize": "5 6"}, "2D image"),
        ({"NDims": "4", "DimSize": "5 6 7 2"}, "4D image"),
        ({"Offset": "10 -20 3_0"}, "'Offset' is missing or not a list of numbers: '10 -20 3_0'"),
        ({"ElementSpacing": "1e400 2 1"}, "'ElementSpacing' is missing or not"),
        ({"TransformMatrix": "0 1 0 nan 0 0 0 0 -1"}, "'TransformMatrix' is missing or not"),
        ({"DimSize": "5 6 1e308"}, "'dimsize' must be whole numbers"),
        ({"HeaderSize": "none"}, "'HeaderSize' is missing or not"),
        ({"DimSize": "900000 900000 900000"}, r"about 2,\d+,\d+,\d+\.\d GiB"),
        ({"ElementType": "MET_ASCII_CHAR"}, "not supported"),
        ({"BinaryData": "False"}, "or as text"),
        ({"HeaderSize": "-1"}, "HeaderSize"),
        ({"ElementDataFile": "elsewhere.raw"}, "'elsewhere.raw', is missing"),
        ({"ElementDataFile": "LIST"}, "several files"),
        ({"ElementDataFile": None}, "not a MetaImage file"),
        ({"TransformMatrix": None}, "header has no orientation .*no TransformMatrix"),
        ({"Offset": None, "offse": "10 -20 30"}, "header has no orientation .*no Offset"),
        ({"ElementSpacing": None, "ElementSpacin": "1.5 2 1"}, "header has no orientation .*no ElementSpacing"),
        ({"BinaryDataByteOrderMSB": None}, "does not give the byte order"),
        ({"BinaryDataByteOrderMSB": "Flse"}, "'binarydatabyteordermsb' is 'flse', neither True nor False"),
        ({"Offset": "10 -20\n30"}, "the MetaImage header is damaged; this line is not a field: '30'"),
    ],
    ids=str,
)
def test_meta_headers_that_are_refused(tmp_path: Path, fields: dict[str, str | None], message: str) -> None:
    with pytest.raises(ImageFileError, match=message):
        read_image(_meta(tmp_path / "a.mha", **fields))


def test_a_detached_file_cut_short_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.raw").write_bytes(_stored()[:-1])
    with pytest.raises(ImageFileError, match=r"a\.raw: the file is incomplete"):
        read_image(_nrrd(tmp_path / "a.nhdr", b"", data_file="a.raw"))
    with pytest.raises(ImageFileError, match=r"a\.raw: the file is incomplete"):
        read_image(_meta(tmp_path / "a.mhd", b"", ElementDataFile="a.raw"))
