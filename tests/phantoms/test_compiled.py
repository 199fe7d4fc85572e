"""Kernels of the phantoms: their references are counted once, not at every point."""

from __future__ import annotations

import sys

import numpy as np

from phantoms import Heel, under_load


def test_what_a_kernel_is_given_is_held_as_often_after_it_as_before():
    heel = Heel(1)
    points = np.random.default_rng(1).uniform(-40.0, 40.0, (1000, 3))
    flow = under_load(heel, "Load3").parts[0]
    given = (points, flow.rest.body.centres_mm, flow.plate_mm, flow.centre_mm, heel.flesh.forms)
    held = [sys.getrefcount(of) for of in given]
    first = flow.evaluate(points)
    for _ in range(3):
        again = flow.evaluate(points)
        heel.tissue_at(points)
        heel.octant_intensity(points, np.eye(3))
    assert [sys.getrefcount(of) for of in given] == held
    np.testing.assert_array_equal(again[1], first[1])
