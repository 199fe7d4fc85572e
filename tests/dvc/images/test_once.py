"""What is found in an image is found once, by whichever thread asks first, and forgotten with the image."""

from __future__ import annotations

import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

from dvc.errors import InputError
from dvc.images.image import Grid, Image
from dvc.images.once import once_an_image


def image(value: float = 1.0) -> Image:
    return Image(Grid((4, 4, 4), np.ones(3), np.zeros(3)), np.full((4, 4, 4), value, dtype=np.float32))


def test_two_threads_that_ask_for_one_image_get_one_result() -> None:
    asked, together = list[Image](), Barrier(2)

    @once_an_image
    def brightness(one: Image) -> np.ndarray:
        asked.append(one)
        return one.values + 1.0

    def ask(one: Image) -> np.ndarray:
        together.wait(timeout=60.0)
        return brightness(one)

    one, other = image(), image()
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(ask, (one, one))
    assert first is second
    assert brightness(other) is not first  # equal, but another image
    assert asked == [one, other]


def test_nothing_is_kept_of_an_image_that_is_gone() -> None:
    @once_an_image
    def brightness(one: Image) -> np.ndarray:
        return one.values + 1.0

    one = image()
    kept = weakref.ref(brightness(one))
    gone = weakref.ref(one)
    assert kept() is not None
    del one
    gc.collect()
    assert gone() is None
    assert kept() is None


def test_an_error_is_not_kept() -> None:
    refusals = [InputError("not yet")]

    @once_an_image
    def brightness(one: Image) -> float:
        if refusals:
            raise refusals.pop()
        return float(one.values.mean())

    one = image(3.0)
    with pytest.raises(InputError, match="not yet"):
        brightness(one)
    assert brightness(one) == 3.0
