"""The errors of mrstrain: one root, and each also a ValueError or a RuntimeError.

A message says what was wrong, which rule it broke, which value was found, and what to do next, in at most three lines
of 100 characters (`tests/test_messages.py`), so a list of any length is shortened (`few`); full detail goes to the log.
"""

import collections.abc
import logging

_log = logging.getLogger(__name__)


class MrstrainError(Exception):
    """Root of every error that mrstrain raises on purpose."""


class InputError(MrstrainError, ValueError):
    """Something given by the user cannot be used: a file, a value, a combination of them."""


class ImageFileError(InputError):
    """An image, mask, label or mesh file that is damaged, unsupported, or ambiguous in its geometry."""


class GeometryError(InputError):
    """Images, masks or meshes that do not share a frame, or do not overlap."""


class ExtentError(GeometryError):
    """A mesh of no body part's size: its unit is another than was said."""


class ParameterError(InputError):
    """A registration parameter that elastix does not know, or a value out of range."""


class RegistrationError(MrstrainError, RuntimeError):
    """A registration that failed, or whose result must not be handed on."""


class WorkerError(MrstrainError, RuntimeError):
    """A worker process that died: killed, out of memory, or crashed in native code."""


class OutputError(MrstrainError, RuntimeError):
    """A result that cannot be written: folder not writable, disk full, output equal to an input."""


def few(items: collections.abc.Iterable[object], most: int = 6) -> str:
    """A list of any length for a message: the first items, and how many more there are.

    >>> few("abcd"), few("abcd", most=2), few([])
    ('a, b, c, d', 'a, b and 2 more', '')
    """
    listed = [str(item) for item in items]
    more = len(listed) - most
    if more > 0:
        _log.info("In full: %s", ", ".join(listed))
    return ", ".join(listed[:most]) + (f" and {more} more" if more > 0 else "")
