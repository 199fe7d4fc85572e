"""Figures of an accuracy study: the numbers that they show, and one mark for each condition."""

from __future__ import annotations

from dataclasses import fields

import pytest

from phantoms import ErrorRow, FloorRow, ResolutionRow, figures

HERE, THERE = ("gauss-newton", "0.8", 25.0), ("heel-mr", "0.8", 25.0)


def test_noise_stands_over_the_wavelength_recovered_to_90_percent() -> None:
    rows = [ResolutionRow(*of, "fat", *at) for of in (HERE, THERE) for at in ((8.0, 0.8), (12.0, 1.0))]
    rows.append(ResolutionRow(*HERE, "skin", 40.0, 0.9))
    floors = [FloorRow(*HERE, "fat", 0.1, 0.1, 0.02, 0.05)]  # none of the other preset
    known = figures.noise_and_resolution(floors, rows, "fat")
    between = pytest.approx(96.0**0.5)  # halfway from 8 to 12 mm, in the logarithm
    assert known == [("gauss-newton, 0.8 mm, SNR 25", between, 0.02)]
    (axes,) = figures.trade_off(known, "fat").axes
    assert [line.get_xydata().tolist() for line in axes.lines] == [[[between, 0.02]]]


def test_errors_are_pooled_by_their_samples_and_small_bins_left_out() -> None:
    def row(motion: str, low: float, high: float, samples: int, rmse: float, bias: float) -> ErrorRow:
        known = {"motion": motion, "low": low, "high": high, "samples": samples, "shear_rmse": rmse, "shear_bias": bias}
        known |= {"tissue": "fat", "by": "true maximum shear strain"}
        return ErrorRow(**{field.name: known.get(field.name, 0.0) for field in fields(ErrorRow)})  # type: ignore[arg-type]

    rows = [
        row("Load1", 0.0, 0.1, 300, 0.03, 0.01), row("Load2", 0.0, 0.1, 100, 0.01, -0.03),
        row("Load1", 0.1, 0.2, 199, 0.5, 0.5), row("Load1", 0.2, float("inf"), 200, 0.04, 0.0),
        row("still", 0.0, 0.1, 9000, 9.0, 9.0),
    ]  # fmt: skip
    pooled = figures.pooled_errors(rows, "true maximum shear strain")
    assert [tissue for tissue, *_ in pooled] == ["fat", "fat"]
    assert pooled[0][1:] == pytest.approx((0.05, ((3 * 0.03**2 + 0.01**2) / 4) ** 0.5, 0.0))
    assert pooled[1][1:] == pytest.approx((0.3, 0.04, 0.0))
