"""Masks and label maps: what a file may hold, names, and the image's grid."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from dvc.errors import GeometryError, InputError
from dvc.images.image import Grid, LabelMap, Mask
from dvc.io.images.labels import fit_mask, read_labels, read_mask, read_names
from dvc.io.images.read import read_image
from dvc.mesh import box_told
from mrstrain.cli.wrapping import wrapped

_TURN = Rotation.from_euler("xyz", [20.0, -35.0, 10.0], degrees=True).as_matrix()
_GRID = Grid((20, 22, 24), (1.0, 1.2, 0.9), (-40.0, 25.0, 310.0), _TURN)


def _save(path: Path, values: Any, grid: Grid | None = None) -> Path:
    affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ (grid.affine if grid is not None else np.eye(4))
    image = nibabel.Nifti1Image(np.asarray(values), affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
    return path


def _block(value: float = 1, dtype: Any = np.uint8) -> np.ndarray:
    values = np.zeros((6, 7, 8), dtype)
    values[1:4, 2:5, 3:6] = value
    return values


def _ball(grid: Grid, radius_mm: float = 6.0, at_mm: Any = None) -> np.ndarray:
    centre = _GRID.centre_mm if at_mm is None else at_mm
    return np.asarray(np.linalg.norm(grid.points() - centre, axis=-1) < radius_mm)


class TestReadMask:
    """A mask file holds zeros and one other value."""

    @pytest.mark.parametrize(
        ("value", "dtype"),
        [(1, np.uint8), (255, np.uint8), (7, np.int16), (1, np.float32), (255, np.float64), (-1, np.int8)],
    )
    def test_any_one_value(self, tmp_path: Path, value: float, dtype: Any) -> None:
        mask = read_mask(_save(tmp_path / "a.nii", _block(value, dtype)))
        np.testing.assert_array_equal(mask.inside, _block() == 1)

    def test_empty(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="the mask is empty; all 336 voxels are 0"):
            read_mask(_save(tmp_path / "a.nii", _block(0)))

    def test_several_values_are_listed(self, tmp_path: Path) -> None:
        values = _block(3)
        values[0, 0, :2] = 9
        with pytest.raises(InputError, match=r"has 2: 3: 27 voxels, 9: 2 voxels\..*--bone-label"):
            read_mask(_save(tmp_path / "a.nii", values))

    def test_a_long_list_is_shortened(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="and 332 more") as caught:
            read_mask(_save(tmp_path / "a.nii", np.arange(336, dtype=np.int16).reshape(6, 7, 8)))
        assert len(str(caught.value)) < 300

    @pytest.mark.parametrize("odd", [0.5, np.nan, np.inf, 1e12])
    def test_values_that_are_no_labels(self, tmp_path: Path, odd: float) -> None:
        values = _block(1, np.float32)
        values[0, 0, 0] = odd
        with pytest.raises(InputError, match="must be whole numbers below 2147483648; 1 voxels are not"):
            read_mask(_save(tmp_path / "a.nii", values))

    def test_labels_too_large(self, tmp_path: Path) -> None:
        sitk.WriteImage(sitk.GetImageFromArray(_block(2**40, np.int64)), str(tmp_path / "a.mha"))
        with pytest.raises(InputError, match="whole numbers below 2147483648; the highest is 1099511627776"):
            read_labels(tmp_path / "a.mha")

    def test_a_folder(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="must be one file, not a folder"):
            read_mask(tmp_path)

    def test_on_the_image_s_grid(self, tmp_path: Path) -> None:
        inside = _ball(_GRID)
        mask = read_mask(_save(tmp_path / "a.nii", inside.astype(np.uint8), _GRID), _GRID)
        assert mask.grid is _GRID
        np.testing.assert_array_equal(mask.inside, inside)


class TestReadLabels:
    """Labels and where their names come from."""

    def test_without_names(self, tmp_path: Path) -> None:
        labels = read_labels(_save(tmp_path / "a.nii", _block(5)))
        assert labels.names == {5: "label-5"}
        np.testing.assert_array_equal(labels.labels, _block(5))
        with pytest.raises(InputError, match=r"no region 'bone'; it has label-5. No table of names was given"):
            labels.region("bone")

    @pytest.mark.parametrize(
        ("asked", "names", "likely"),
        [
            ("calcaneus", ("bone", "fat"), "'bone'"),
            ("bone", ("calcaneus", "fat", "skin"), "'calcaneus'"),
            ("calcaneus", ("talus", "tibia"), ""),
            ("calcaneus", ("fat", "skin"), ""),
            ("muscle", ("bone", "fat"), ""),
        ],
    )
    def test_a_bone_of_another_name_is_pointed_to_where_there_is_one(
        self, asked: str, names: tuple[str, ...], likely: str
    ) -> None:
        grid, known = Grid((4, 1, 1), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), dict(enumerate(names, 1))
        labels = LabelMap(grid, np.resize([*known], (4, 1, 1)), known)
        told = f"; it has {', '.join(names)}." + (f" Did you mean {likely}?" if likely else "")
        with pytest.raises(InputError, match=re.escape(told) + "$"):
            labels.region(asked)

    def test_names_that_are_not_in_the_map_are_let_go(self, tmp_path: Path) -> None:
        path = _save(tmp_path / "a.nii", _block(5))
        assert read_labels(path, {5: "fat", 6: "skin"}).names == {5: "fat"}

    def test_labels_without_a_name_are_refused(self, tmp_path: Path) -> None:
        values = _block(5)
        values[0, 0, 0] = 8
        with pytest.raises(InputError, match=r"labels without a name: 8\. Names are given for 5, 6"):
            read_labels(_save(tmp_path / "a.nii", values), {5: "fat", 6: "skin"})
        (tmp_path / "n.csv").write_text("label,name\n5,fat\n")
        with pytest.raises(InputError, match=r"without a name in .*n\.csv: 8"):
            read_labels(tmp_path / "a.nii", tmp_path / "n.csv")

    def test_empty_and_negative(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="the label map is empty"):
            read_labels(_save(tmp_path / "a.nii", _block(0)))
        with pytest.raises(InputError, match="must not be negative; found -3"):
            read_labels(_save(tmp_path / "a.nii", _block(-3, np.int16)))

    def test_slicer_s_segmentation_brings_its_names(self, tmp_path: Path) -> None:
        values = _block(2)
        values[5] = 7
        path = self._segmentation(tmp_path / "a.seg.nrrd", values)
        labels = read_labels(path)
        assert labels.names == {2: "fat pad", 7: "peau épaisse"}
        np.testing.assert_array_equal(labels.region("fat pad").inside, values == 2)
        with pytest.raises(InputError, match=r"2 \(fat pad\): 27 voxels, 7 \(peau épaisse\)"):
            read_mask(path)
        assert read_labels(path, {2: "a", 7: "b"}).names == {2: "a", 7: "b"}

    def test_overlapping_segments_are_refused(self, tmp_path: Path) -> None:
        layers = np.stack([_block(1), _block(1)[::-1]])
        with pytest.raises(InputError, match=r"2 layers.*export the segments to a label map"):
            read_labels(self._segmentation(tmp_path / "a.seg.nrrd", layers))

    def _segmentation(self, path: Path, values: np.ndarray) -> Path:
        layers = values.ndim == 4
        header = [
            "NRRD0004",
            "# Complete NRRD file format specification at:",
            "type: unsigned char",
            f"dimension: {values.ndim}",
            "space: left-posterior-superior",
            f"sizes: {' '.join(map(str, values.shape))}",
            f"space directions: {'none ' if layers else ''}(1,0,0) (0,1,0) (0,0,1)",
            f"kinds: {'list ' if layers else ''}domain domain domain",
            "encoding: raw",
            "space origin: (0,0,0)",
            "Segment0_ID:=Segment_1",
            "Segment0_LabelValue:=2",
            "Segment0_Name:=fat pad",
            "Segment0_Tags:=Segmentation.Status:inprogress|TerminologyEntry:Segmentation category~SCT",
            "Segment1_LabelValue:=7",
            "Segment1_Name:=peau épaisse",
            "Segmentation_ContainedRepresentationNames:=Binary labelmap|",
        ]
        path.write_bytes(("\n".join(header) + "\n\n").encode() + values.tobytes(order="F"))
        return path


class TestNames:
    """Tables of names."""

    @pytest.mark.parametrize(
        ("name", "text"),
        [
            ("a.csv", "label,name\n1,fat\n4,muscle belly\n"),
            ("a.csv", "\ufeffName , Value\nfat,1\nmuscle belly,4\n"),
            ("a.csv", "# ours\nid,structure,colour\n1,fat,red\n\n4,muscle belly,blue\n"),
            ("a.csv", 'INDEX,LABEL\n1,"fat"\n4,"muscle belly"\n'),
            ("a.csv", "label,name\n0,background\n1,fat\n4,muscle belly\n"),
            (
                "a.txt",
                "################\n# ITK-SnAP Label Description File\n"
                '    0     0    0    0        0  0  0    "Clear Label"\n'
                '    1   255    0    0        1  1  1    "fat"\n'
                '    4     0  255    0      0.5  1  1    "muscle belly"\n',
            ),
            (
                "a.ctbl",
                "# Color\n  # of a person\n0 Background 0 0 0 0\n1 fat 255 0 0 255\n4 muscle belly 0 255 0 255\n",
            ),
        ],
    )
    def test_kinds(self, tmp_path: Path, name: str, text: str) -> None:
        (tmp_path / name).write_text(text, encoding="utf-8")
        assert read_names(tmp_path / name) == {1: "fat", 4: "muscle belly"}

    @pytest.mark.parametrize(
        ("name", "text"),
        [
            ("a.csv", ""),
            ("a.csv", "1,fat\n2,skin\n"),
            ("a.csv", "label,name\nfat,1\n"),
            ("a.csv", "label,name\n\u00b2,fat\n"),
            ("a.csv", "label,colour\n1,red\n"),
            ("a.txt", "fat and skin\n"),
            ("a.txt", "1 fat 255 0 0 255\nskin\n"),
            ("a.txt", "\u00b2 fat 255 0 0 255\n"),
            ("a.txt", ""),
        ],
    )
    def test_other_tables_are_refused(self, tmp_path: Path, name: str, text: str) -> None:
        (tmp_path / name).write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match="not a table of labels and names"):
            read_names(tmp_path / name)

    @pytest.mark.parametrize(("name", "text"), [("a.ctbl", "1 fat 255 0 0 25"), ("a.csv", 'label,name\n3,"mus')])
    def test_a_table_cut_in_a_line_is_refused(self, tmp_path: Path, name: str, text: str) -> None:
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=rf"{name}.*(ends in the middle of a line|unexpected end of data)"):
            read_names(tmp_path / name)

    def test_a_label_named_twice(self, tmp_path: Path) -> None:
        (tmp_path / "a.csv").write_text("label,name\n1,fat\n1,skin\n")
        with pytest.raises(InputError, match="label 1 has two names, 'fat' and 'skin'"):
            read_names(tmp_path / "a.csv")

    def test_files_that_cannot_be_read(self, tmp_path: Path) -> None:
        (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\x01")
        for name in ("a.csv", "missing.csv"):
            with pytest.raises(InputError, match="cannot be read"):
                read_names(tmp_path / name)


class TestFitMask:
    """A mask on the image's grid, another grid of its frame, or another frame."""

    def test_last_digits_take_the_image_s_geometry(self, caplog: pytest.LogCaptureFixture) -> None:
        direction = Rotation.from_rotvec([0, 0, 1e-5]).as_matrix() @ _TURN
        near = Grid(_GRID.shape, _GRID.spacing_mm + 1e-6, _GRID.origin_mm + 1e-4, direction)
        inside = np.random.default_rng(0).random(_GRID.shape) < 0.5
        fitted = fit_mask(Mask(near, inside), _GRID)
        assert fitted.grid is _GRID
        np.testing.assert_array_equal(fitted.inside, inside)
        assert caplog.text == ""

    def test_a_cropped_grid(self, caplog: pytest.LogCaptureFixture) -> None:
        crop = Grid((9, 10, 11), _GRID.spacing_mm, _GRID.points_at(np.array([4.0, 5.0, 6.0])), _TURN)
        inside = np.random.default_rng(0).random(crop.shape) < 0.5
        fitted = fit_mask(Mask(crop, inside), _GRID, "bone.nii")
        expected = np.zeros(_GRID.shape, dtype=bool)
        expected[4:13, 5:15, 6:17] = inside
        np.testing.assert_array_equal(fitted.inside, expected)
        assert "bone.nii: on another grid than the image; resampled" in caplog.text

    def test_a_flipped_and_permuted_grid_keeps_every_voxel(self) -> None:
        inside = np.random.default_rng(0).random(_GRID.shape) < 0.5
        turned = Mask(_GRID, inside).toward_lps()
        back = fit_mask(turned, _GRID)
        np.testing.assert_array_equal(back.inside, inside)
        other = Grid((24, 20, 22), _GRID.spacing_mm[[2, 0, 1]], _GRID.origin_mm, _TURN[:, [2, 0, 1]])
        np.testing.assert_array_equal(fit_mask(Mask(other, inside.transpose(2, 0, 1)), _GRID).inside, inside)

    @pytest.mark.parametrize("factor", [0.5, 2.0])
    @pytest.mark.parametrize("angle", [0.0, 25.0])
    def test_a_coarser_finer_or_turned_grid(self, factor: float, angle: float) -> None:
        direction = _TURN @ Rotation.from_euler("z", angle, degrees=True).as_matrix()
        shape = tuple(round(1.6 * n / factor) for n in _GRID.shape)
        half = (np.array(shape) - 1) / 2.0
        spacing = _GRID.spacing_mm * factor
        other = Grid(shape, spacing, _GRID.centre_mm - direction @ (spacing * half), direction)
        fitted = fit_mask(Mask(other, _ball(other)), _GRID)
        wrong = np.argwhere(fitted.inside != _ball(_GRID))
        # nearest neighbour is wrong only within half a diagonal of a voxel of the sphere's surface
        distance = np.linalg.norm(_GRID.points_at(wrong.astype(float)) - _GRID.centre_mm, axis=1)
        assert np.abs(distance - 6.0).max(initial=0.0) <= 0.5 * np.linalg.norm(spacing) + 1e-9
        assert fitted.volume_mm3 == pytest.approx(4 / 3 * np.pi * 6.0**3, rel=0.08)

    @settings(max_examples=30, deadline=None)
    @given(
        st.tuples(*[st.integers(1, 3)] * 3),
        st.tuples(*[st.integers(0, 2)] * 3),
        st.integers(0, 2**31),
    )
    def test_voxels_split_into_whole_parts_come_back(
        self, parts: tuple[int, int, int], offset: tuple[int, int, int], seed: int
    ) -> None:
        coarse = Grid((5, 6, 4), (2.0, 3.0, 2.5), (-7.0, 11.0, 5.0), _TURN)
        shape = np.array(coarse.shape) * parts
        fine_spacing = coarse.spacing_mm / parts
        first = coarse.points_at((0.5 / np.array(parts)) - 0.5)
        fine = Grid(tuple(int(n) for n in shape), fine_spacing, first, _TURN)
        values = np.random.default_rng(seed).random(coarse.shape) < 0.4
        values[offset] = True
        expected = values.repeat(parts[0], 0).repeat(parts[1], 1).repeat(parts[2], 2)
        np.testing.assert_array_equal(fit_mask(Mask(coarse, values), fine).inside, expected)

    def test_labels_keep_their_names_and_losses_are_told(self, caplog: pytest.LogCaptureFixture) -> None:
        fine = Grid((40, 44, 48), _GRID.spacing_mm / 2, _GRID.origin_mm - _TURN @ (_GRID.spacing_mm / 4), _TURN)
        labels = np.where(_ball(fine), 3, 0)
        labels[2, 2, 2] = 8  # one voxel of a fine grid, which is no coarse voxel's nearest
        fitted = fit_mask(LabelMap(fine, labels, {3: "talus", 8: "vessel"}), _GRID)
        assert set(np.unique(fitted.labels)) == {0, 3}
        assert fitted.region("talus").volume_mm3 == pytest.approx(4 / 3 * np.pi * 6.0**3, rel=0.08)
        assert "regions lost by resampling: ['vessel']" in caplog.text

    def test_another_frame_is_refused_with_both_boxes(self) -> None:
        far = Grid(_GRID.shape, _GRID.spacing_mm, _GRID.origin_mm + 500.0, _TURN)
        with pytest.raises(GeometryError, match="0 % of its volume is inside the image") as caught:
            fit_mask(Mask(far, _ball(_GRID)), _GRID, "bone.nii")
        assert f"It spans {box_told(*far.bounds_mm())} mm; the image {box_told(*_GRID.bounds_mm())} mm" in str(
            caught.value
        )

    def test_refusals_of_large_oblique_grids_are_three_lines(self) -> None:
        turn = Rotation.from_rotvec([0.1, 0.2, 0.05]).as_matrix()
        image = Grid((256, 280, 264), (0.8, 0.8, 0.8), (-101.325, -112.447, -98.123), turn)
        aside = Grid((256, 280, 264), (0.625, 0.625, 1.5), (-301.325, -112.447, -98.123), turn)
        flip = np.array([-1.0, -1.0, 1.0])
        mirrored = Grid(image.shape, image.spacing_mm, image.origin_mm * flip, image.direction * flip[:, None])
        of_bone = np.zeros(image.shape, dtype=bool)
        of_bone[100:140, 100:140, 50:100] = True
        for grid in (aside, mirrored):
            with pytest.raises(GeometryError) as caught:
                fit_mask(Mask(grid, of_bone), image, "/data/heel-17/masks/calcaneus.nii.gz")
            assert len(wrapped(f"mrstrain: {caught.value}").splitlines()) <= 3

    @pytest.mark.parametrize(("shift", "refused"), [(9.0, False), (11.0, True)])
    def test_half_of_the_volume_must_lie_in_the_image(self, shift: float, refused: bool) -> None:
        origin = _GRID.points_at(np.array([shift, 0.0, 0.0]))
        full = Mask(Grid(_GRID.shape, _GRID.spacing_mm, origin, _TURN), np.ones(_GRID.shape, dtype=bool))
        if refused:
            with pytest.raises(GeometryError, match="45 % of its volume"):
                fit_mask(full, _GRID)
        else:
            assert fit_mask(full, _GRID).volume_mm3 == pytest.approx(full.volume_mm3 * 11 / 20)

    @pytest.mark.parametrize("signs", [(-1, -1, 1), (1, 1, -1), (-1, 1, 1)])
    def test_a_header_of_the_other_handedness_is_refused(self, signs: tuple[int, int, int]) -> None:
        flip = np.array(signs, dtype=float)
        # close to the frame's origin the mirrored grid overlaps the image for the most part
        grid = Grid((40, 44, 48), (1.0, 1.2, 0.9), (-18.0, -24.0, -20.0))
        mirrored = Grid(grid.shape, grid.spacing_mm, grid.origin_mm * flip, grid.direction * flip[:, None])
        mask = Mask(mirrored, _ball(grid, 6.0, np.array([3.0, 4.0, 2.0])))
        with pytest.raises(GeometryError, match="RAS and LPS coordinates were mixed up"):
            fit_mask(mask, grid)

    def test_of_an_image_that_is_its_own_mirror_image_the_usual_mistake_is_named(self) -> None:
        grid = Grid((40, 45, 48), (1.0, 1.0, 0.9), (-18.0, -22.0, -20.0))  # y runs from -22 to 22 mm
        flip = np.array([-1.0, -1.0, 1.0])
        mirrored = Grid(grid.shape, grid.spacing_mm, grid.origin_mm * flip, grid.direction * flip[:, None])
        with pytest.raises(GeometryError, match="with x and y negated: RAS and LPS"):
            fit_mask(Mask(mirrored, _ball(grid, 6.0, np.array([3.0, 4.0, 2.0]))), grid)

    def test_nothing_left_on_a_coarse_grid(self) -> None:
        fine = Grid((40, 44, 48), _GRID.spacing_mm / 4, _GRID.origin_mm, _TURN)
        one = np.zeros(fine.shape, dtype=bool)
        one[2, 2, 2] = True
        with pytest.raises(GeometryError, match="no voxel is left"):
            fit_mask(Mask(fine, one), _GRID)

    def test_empty(self) -> None:
        other = Grid(_GRID.shape, _GRID.spacing_mm, _GRID.origin_mm + 1.0, _TURN)
        with pytest.raises(GeometryError, match="all voxels are 0"):
            fit_mask(Mask(other, np.zeros(other.shape, dtype=bool)), _GRID)


def test_real_labels(real_data: Path) -> None:
    labels = read_labels(real_data / "knee-labels" / "SAG_3D_DESS_RIGHT_bones_cart_men_fib-label.nrrd")
    assert labels.grid.shape == (384, 384, 160)
    assert len(labels.names) > 3
    legs = read_labels(real_data / "leg-mr" / "labels.nii.gz")
    assert len(legs.names) == 14
    # the labels belong to another field of view than these images
    with pytest.raises(GeometryError, match="0 % of its volume"):
        fit_mask(legs, read_image(real_data / "leg-mr" / "fat.nii.gz").grid)
    lung = real_data / "lung-landmarks"
    mask = read_mask(lung / "3DCT_lung_baseline_mask.mha", read_image(lung / "3DCT_lung.mha").grid)
    assert 0.2 < mask.inside.mean() < 0.6
