"""Lines for a terminal: what a command says is broken between words, and paths stay in one piece."""

import textwrap

_WIDTH = 100  # of a line


def wrapped(message: str, hanging: str = "") -> str:
    """A message in lines of at most 100 characters, broken between words; paths and options are kept in one piece.

    Its own lines stay. What follows one of them is indented as it is, and by ``hanging``.
    """
    lines = list[str]()
    for line in message.splitlines():
        indent = line[: len(line) - len(line.lstrip())] + hanging
        broken = textwrap.wrap(
            line, _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )  # fmt: skip
        lines += broken or [""]
    return "\n".join(lines)
