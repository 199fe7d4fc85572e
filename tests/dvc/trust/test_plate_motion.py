"""Tissue between bone and plate that moves towards the plate: swapped images, or a plate normal the wrong way round."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.deformation.protocol import Affine
from dvc.deformation.strain_maps import strain_maps
from dvc.images.image import Grid, Image, Mask
from dvc.measurement.measurement import Measurement
from dvc.measurement.subject import Subject
from dvc.trust.assessment import Similarity, assess
from dvc.trust.plate_motion import displacement_along_normal

GRID = Grid((30, 26, 40), np.array([1.0, 1.2, 1.5]), np.array([-15.0, 5.0, -30.0]))
WHOLE = Mask(GRID, np.ones(GRID.shape, dtype=bool))
ALIKE = Similarity((0.3, 0.5, 0.9))
INFERIOR = np.array([0.0, 0.0, -1.0])
LOWEST_MM, BONE_MM = -30.0, -7.5  # of the tissue, and of the bone, along superior


def bone() -> Mask:
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[8:20, 6:16, 15:25] = True
    return Mask(GRID, inside)


def pressed(by: float) -> Affine:
    """Thinner by a fraction between the lowest tissue and the bone's lowest end, which stays."""
    return Affine(np.diag([1.0, 1.0, 1.0 - by]), np.array([0.0, 0.0, by * BONE_MM]))


def along_normal(deformation: Affine, normal: np.ndarray = INFERIOR, tissue: Mask = WHOLE) -> float:
    return displacement_along_normal(strain_maps(deformation, tissue), tissue, bone(), normal)


@pytest.mark.parametrize("by", [0.2, -0.2])
def test_it_is_the_displacement_of_the_outermost_tissue_under_the_bone(by: float) -> None:
    outer = np.array([LOWEST_MM, LOWEST_MM + 1.5])  # two layers lie within 3 mm
    assert along_normal(pressed(by)) == pytest.approx(float((by * (outer - BONE_MM)).mean()), abs=1e-5)


def test_tissue_beside_the_bone_and_beyond_it_does_not_count() -> None:
    inside = WHOLE.inside.copy()
    inside[8:20, 6:16, :15] = False
    assert np.isnan(along_normal(pressed(0.2), tissue=Mask(GRID, inside)))
    assert np.isnan(along_normal(pressed(0.2), tissue=Mask(GRID, bone().inside)))


def test_a_plate_from_another_side_sees_another_surface() -> None:
    posterior = np.array([0.0, 1.0, 0.0])
    bulging = Affine(np.diag([1.0, 1.1, 1.0]), np.array([0.0, -0.1 * 5.0, 0.0]))  # from the anterior side at 5 mm
    outer = GRID.points()[0, -3:, 0, 1]
    assert along_normal(bulging, posterior) == pytest.approx(float((0.1 * (outer - 5.0)).mean()), abs=1e-5)


def test_a_loaded_image_taken_for_the_unloaded_one_is_used_with_care() -> None:
    def level_and_reasons(by: float, normal: np.ndarray | None, **images: object) -> tuple[str, str]:
        known = {"similarity": ALIKE} | images
        quality = assess(
            strain_maps(pressed(by), WHOLE), WHOLE, bone(), in_bone=(0.0, 0.0), plate_normal=normal, **known
        )
        return quality.verdict.level, " ".join(quality.verdict.reasons)

    level, reasons = level_and_reasons(-0.1, INFERIOR)
    assert level == "caution"
    assert "moves away from it, by 2.2 mm" in reasons
    assert "swapped" in reasons
    assert level_and_reasons(0.1, INFERIOR) == level_and_reasons(-0.02, INFERIOR) == ("trust", "")
    # where no plate is known, the side that moves most tells
    level, reasons = level_and_reasons(-0.1, None)
    assert level == "caution"
    assert "away from the bone on its superior side, by 3.5 mm" in reasons  # of a strain that is the same everywhere
    assert "give the direction to it (plate_normal)" in reasons
    assert level_and_reasons(0.1, None) == level_and_reasons(-0.02, None) == ("trust", "")
    assert "swapped" not in level_and_reasons(-0.1, None, similarity=None)[1]


def test_a_measurement_is_judged_by_the_normal_alone() -> None:
    def reasons(**known: object) -> str:
        subject = Subject(Image(GRID, np.ones(GRID.shape, dtype=np.float32)), bone(), WHOLE, **known)
        return " ".join(Measurement.from_deformation(pressed(-0.1), subject).verdict.reasons)

    assert "swapped" in reasons(plate_normal=INFERIOR, pressed=True)
    assert "swapped" not in reasons(plate_normal=INFERIOR)
