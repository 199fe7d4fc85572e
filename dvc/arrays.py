"""Array types, and read-only arrays for value objects."""

import copyreg
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

_T = TypeVar("_T", bound=np.generic)

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


def _sealed(content: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(content)


copyreg.pickle(MappingProxyType, lambda proxy: (_sealed, (dict(proxy),)))  # value objects hold them, and are pickled


def frozen(values: npt.ArrayLike, dtype: type[_T]) -> npt.NDArray[_T]:
    """``values`` as a read-only, C-ordered array of ``dtype``, copied only if needed; the caller's stays writable."""
    array = np.ascontiguousarray(values, dtype=dtype).view()
    array.flags.writeable = False
    return array
