import numpy as np
import pytest

from dvc.arrays import different, different_and_places


@pytest.mark.parametrize("values", [
    np.array([[3, -1, 3], [0, 7, -1]]), np.arange(2000)[::-1], np.array([10**12, -(10**12), 5, 5]),
    np.repeat([4, -2, 9], 5000).reshape(3, 50, 100), np.empty((0, 3), dtype=np.int64),
])  # fmt: skip
def test_different_numbers_and_their_places_are_those_of_numpy(values: np.ndarray) -> None:
    found, places = different_and_places(values)
    expected, at = np.unique(values, return_inverse=True)
    assert np.array_equal(found, expected)
    assert np.array_equal(different(values), expected)
    assert places.shape == values.shape
    assert np.array_equal(places, at.reshape(values.shape))
