"""Lines for a terminal: what a command says is broken between words, and paths stay in one piece."""

import os
import textwrap

_WIDTH = 100  # of a line
_COMMAND = "mrstrain "


def wrapped(message: str, hanging: str = "") -> str:
    """A message in lines of at most 100 characters, broken between words; paths and options are kept in one piece.

    Its own lines stay. What follows one of them is indented as it is, and by ``hanging``. A line that is a command of
    mrstrain can be pasted into a shell: its parts are joined by a backslash. On Windows it is not broken.
    """
    lines = list[str]()
    for line in message.splitlines():
        if line.lstrip().startswith(_COMMAND):
            lines.append(_command(line))
            continue
        indent = line[: len(line) - len(line.lstrip())] + hanging
        broken = textwrap.wrap(
            line, _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )  # fmt: skip
        lines += broken or [""]
    return "\n".join(lines)


def _command(line: str) -> str:
    """A command in lines that a shell reads as one."""
    if os.name == "nt":
        return line
    parts = textwrap.wrap(
        line, _WIDTH - 2, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )  # fmt: skip
    return " \\\n".join(parts)
