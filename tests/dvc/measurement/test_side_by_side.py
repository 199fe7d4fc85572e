"""The loads side by side: the unloaded image, then each load's own measured strain, in one slice with one scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import ImageFileError, InputError
from dvc.images.image import Grid, Image, Mask
from dvc.io.images.write import write_image
from dvc.io.result_folder import read_scalar
from dvc.measurement.page import strain_drawing
from dvc.measurement.side_by_side import measured_by_load, on_one_scale, shared_scale
from dvc.measurement.subject import Subject
from dvc.report.page import Section
from dvc.report.sheet import View

GRID = Grid((10, 12, 14), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
STRAINS = {"Load1": 0.05, "Load2": 0.31}


@pytest.fixture
def subject() -> Subject:
    body, bone = (np.zeros(GRID.shape, dtype=bool) for _ in range(2))
    body[1:-1, 1:-1, 1:-1] = True
    bone[3:6, 4:8, 6:10] = True  # its lowest voxels have z = 6 mm
    return Subject(Image(GRID, body.astype(np.float32)), Mask(GRID, bone), Mask(GRID, body))


@pytest.fixture
def folders(tmp_path: Path) -> dict[str, Path]:
    for load, strain in STRAINS.items():
        (tmp_path / load).mkdir()
        values = np.full(GRID.shape, strain, dtype=np.float32)
        values[..., :3] = np.nan
        write_image(tmp_path / load / "max_shear.nii.gz", Image(GRID, values))
    return {load: tmp_path / load for load in STRAINS}


def panels(subject: Subject, folders: dict[str, Path]) -> tuple[list[str], list[np.ma.MaskedArray], str]:
    """Titles of the panels, the strain in those of the loads, and the caption."""
    drawing = measured_by_load(subject, folders)
    *slices, bar = drawing.figure.axes
    strains = [axes.images[1].get_array() for axes in slices[1:]]
    assert len(slices[0].images) == 1  # the image alone
    assert {axes.images[1].norm.vmax for axes in slices[1:]} == {0.35} == {bar.get_xlim()[1]}
    return [axes.get_title() for axes in slices], strains, drawing.caption


def test_each_load_has_its_own_strain_in_soft_tissue_alone(subject: Subject, folders: dict[str, Path]) -> None:
    titles, strains, caption = panels(subject, folders)
    assert titles == ["Load0", "Load1", "Load2"]
    # Sagittal at the first of the bone's lowest voxels, x = 3 mm: superior is up, anterior on the left.
    assert "Sagittal, x = 3 mm, through the point of the bone nearest to the plate." in caption
    body, bone, valid = np.zeros((14, 12), dtype=bool), np.zeros((14, 12), dtype=bool), np.ones((14, 12), dtype=bool)
    body[1:-1, 1:-1] = bone[14 - 10 : 14 - 6, 4:8] = True
    valid[-3:] = False
    for page, strain in zip(strains, STRAINS.values(), strict=True):
        np.testing.assert_array_equal(~np.ma.getmaskarray(page), body & ~bone & valid)
        np.testing.assert_allclose(page.compressed(), strain, rtol=1e-6)


def test_on_a_narrow_screen_the_strains_come_first_in_two_columns(subject: Subject, folders: dict[str, Path]) -> None:
    drawing = measured_by_load(subject, folders)
    assert drawing.narrow is not None
    first, second, unloaded, bar = drawing.narrow.axes
    assert [axes.get_title() for axes in (first, second, unloaded)] == ["Load1", "Load2", "Load0"]
    for axes, strain in ((first, 0.05), (second, 0.31)):
        np.testing.assert_allclose(axes.images[1].get_array().compressed(), strain, rtol=1e-6)
        assert axes.images[1].norm.vmax == 0.35 == bar.get_xlim()[1]
    assert len(unloaded.images) == 1
    left, right, small, below = (axes.get_position() for axes in (first, second, unloaded, bar))
    assert left.y0 == right.y0 > small.y1
    assert left.x1 < right.x0
    assert small.width == pytest.approx(0.6 * left.width)
    assert small.x1 < below.x0
    assert max(right.x1, below.x1) <= 1.0
    assert drawing.narrow.get_size_inches()[0] < 4.5
    assert [sum(line.get_linewidth() == 2.5 for line in axes.lines) for axes in (first, second, unloaded)] == [1, 0, 0]
    one = measured_by_load(subject, {"Load1": folders["Load1"]}).narrow
    assert one is not None
    alone, unloaded, bar = one.axes
    assert alone.get_position().width > 0.8  # a single load fills the width
    assert unloaded.get_position().width < 0.35
    assert unloaded.get_position().x1 < bar.get_position().x0


@pytest.mark.usefixtures("real_pictures")
def test_pictures_of_single_loads_get_the_colours_of_the_load_with_most_strain(
    subject: Subject, folders: dict[str, Path]
) -> None:
    def section(load: str) -> Section:
        shear = read_scalar(folders[load] / "max_shear.nii.gz").values
        view = View.through(GRID, subject.lowest_bone_point_mm, np.isfinite(shear))
        drawing = strain_drawing(view, subject, subject.regions(subject.body()), shear, None, loaded="loaded")
        return Section(load, pictures=(drawing.picture(),))

    before = [section(load) for load in folders]
    weak, strong = on_one_scale(before, subject, folders)
    assert shared_scale(folders.values()) == 0.35
    assert strong is before[1]  # its own scale ends there
    assert "The scale ends at 0.05 (" in before[0].pictures[0].caption
    assert "one colour scale. It ends at 0.35 (" in weak.pictures[0].caption
    assert weak.pictures[0].png != before[0].pictures[0].png
    third = folders["Load1"].with_name("Load3")
    third.mkdir()
    (third / "max_shear.nii.gz").write_bytes(b"damaged")
    damaged = replace(before[0], title="Load3")
    with_third = on_one_scale([*before, damaged], subject, folders | {"Load3": third})
    assert with_third[0].pictures[0].png == weak.pictures[0].png  # the others still share theirs
    assert with_third[2] is damaged
    repeat = {name: folder.rename(folder.with_name("repeat")) if name == "Load2" else folder
              for name, folder in folders.items()}  # fmt: skip
    assert on_one_scale(before, subject, repeat)[0] is before[0]  # a repeat scan has no say
    (folders["Load1"] / "max_shear.nii.gz").unlink()
    assert on_one_scale(before, subject, repeat) == before


def test_the_slice_has_the_plates_normal_and_its_shear_in_it(subject: Subject, folders: dict[str, Path]) -> None:
    from_the_side = replace(subject, plate_normal=np.array([1.0, 0.0, 0.0]))
    assert "Coronal" in panels(from_the_side, folders)[2]
    shears_left = replace(subject, axes=np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]))
    assert "Coronal" in panels(shears_left, folders)[2]


def test_without_a_bone_it_goes_through_the_middle(subject: Subject, folders: dict[str, Path]) -> None:
    titles, strains, caption = panels(replace(subject, bone=None), folders)
    assert titles[1:] == list(folders)
    assert "through the middle of the tissue. All maps of the maximum shear strain in this report have one" in caption
    assert strains[0].count() == 12 * 10 - 2 * 10  # of the body, without what is not valid


def test_a_map_that_is_lacking_or_lies_elsewhere_is_refused(subject: Subject, folders: dict[str, Path]) -> None:
    write_image(
        folders["Load2"] / "max_shear.nii.gz", Image(Grid((4, 4, 4), (1.0,) * 3, (0.0,) * 3), np.ones((4,) * 3))
    )
    with pytest.raises(ImageFileError):
        measured_by_load(subject, folders)
    (folders["Load2"] / "max_shear.nii.gz").unlink()
    with pytest.raises((InputError, ImageFileError), match="Load2"):
        measured_by_load(subject, folders)
