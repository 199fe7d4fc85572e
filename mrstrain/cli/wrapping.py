"""Messages in lines of a terminal."""

import textwrap

_WIDTH = 100  # of a line of an error


def wrapped(message: str) -> str:
    """A message in lines of at most 100 characters, broken between words; paths and options are kept in one piece.

    Its own lines stay; what one of them is indented by, its continuation is as well.
    """
    lines = list[str]()
    for line in message.splitlines():
        indent = line[: len(line) - len(line.lstrip())]
        broken = textwrap.wrap(
            line, _WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
        )  # fmt: skip
        lines += broken or [""]
    return "\n".join(lines)
