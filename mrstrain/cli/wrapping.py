"""Lines for a terminal: what a command says is broken between words, and paths stay in one piece."""

import os
import re
import textwrap

_WIDTH = 100  # of a line
_COMMAND = re.compile(r"mrstrain \w+ (?!.*[.,;:] )")  # and no sentence that begins with the name


def wrapped(message: str, hanging: str = "") -> str:
    """A message in lines of at most 100 characters, broken between words; paths and options are kept in one piece.

    Its own lines stay. What follows one of them is indented as it is, and by ``hanging``. A line that is a command of
    mrstrain can be pasted into a shell: its parts are joined by a backslash. On Windows it is not broken.
    """
    lines = list[str]()
    for line in message.splitlines():
        if _COMMAND.match(line):
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
    lines = [""]
    for part in re.findall(r"(?:'[^']*'|\S)+", line):  # what is in quotation marks stays together
        if lines[-1].strip() and len(lines[-1]) + 1 + len(part) > _WIDTH - 2:
            lines.append(" " * 4)
        lines[-1] += part if not lines[-1].strip() else f" {part}"
    return " \\\n".join(lines)
