"""What is found in an image once, however many ask for it, and forgotten with the image."""

from collections.abc import Callable
from functools import wraps
from threading import Lock
from typing import TypeVar
from weakref import WeakKeyDictionary

from dvc.images.image import Image

_T = TypeVar("_T")


def once_an_image(find: Callable[[Image], _T]) -> Callable[[Image], _T]:
    """A function that keeps what it found in an image, which nobody may change, for as long as the image is in use.

    Two threads that ask for the same image wait for one another; an error is not kept.
    """
    found, at_work, of_both = WeakKeyDictionary[Image, _T](), WeakKeyDictionary[Image, Lock](), Lock()

    @wraps(find)
    def once(image: Image) -> _T:
        with of_both:
            mine = at_work.setdefault(image, Lock())
        with mine:
            with of_both:
                if image in found:
                    return found[image]
            result = find(image)
            with of_both:
                found[image] = result
            return result

    return once
