"""Array types, and read-only arrays for value objects."""

import copyreg
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from dvc.arguments import shown
from dvc.errors import InputError

_T = TypeVar("_T", bound=np.generic)
_FEW = 1000  # numbers: sorting takes no time

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def _sealed(content: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(content)


copyreg.pickle(MappingProxyType, lambda proxy: (_sealed, (dict(proxy),)))  # value objects hold them, and are pickled


def frozen(values: npt.ArrayLike, dtype: type[_T]) -> npt.NDArray[_T]:
    """``values`` as a read-only, C-ordered array of ``dtype``, copied only if needed; the caller's stays writable."""
    try:
        array = np.ascontiguousarray(values, dtype=dtype).view()
    except (TypeError, ValueError) as failure:
        raise InputError(f"An array of numbers is needed; got {shown(values)}.") from failure
    array.flags.writeable = False
    return array


def different(values: IntArray) -> IntArray:
    """The different whole numbers in an array, ascending.

    As `numpy.unique`, which sorts; counting takes a tenth of the time where they lie close together, as labels do.
    """
    if not values.size or values.min() < 0 or values.max() >= max(values.size, _FEW):
        return np.unique(values)
    return np.flatnonzero(np.bincount(values.ravel()))


def different_and_places(values: IntArray) -> tuple[IntArray, IntArray]:
    """The different whole numbers in an array, ascending, and the place of each value among them; as `different`."""
    least, greatest = (int(values.min()), int(values.max())) if values.size else (0, _FEW)
    if greatest - least >= max(values.size, _FEW):
        found, places = np.unique(values, return_inverse=True)
        return found, places.reshape(values.shape)
    above = values - least
    there = np.bincount(above.ravel()) > 0
    return least + np.flatnonzero(there), (np.cumsum(there) - 1)[above]


def numbers(words: Sequence[str]) -> FloatArray:
    """Words of a file as numbers (n,); ValueError for one that is none, such as 1_0, which only Python takes for 10."""
    if odd := [word for word in words if "_" in word]:
        raise ValueError(f"could not convert string to float: '{odd[0]}'")
    return np.array([float(word) for word in words], dtype=np.float64)


def as_points(points_mm: npt.ArrayLike) -> FloatArray:
    """Points (n, 3), C-ordered; InputError for any other shape, which compiled loops would read past."""
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"Points must be an array (n, 3), LPS mm; got shape {points.shape}. One point: [[x, y, z]].")
    return points
