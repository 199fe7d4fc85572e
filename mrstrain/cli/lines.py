"""Results of a command, on standard output."""

import logging

import typer

from mrstrain.cli.wrapping import wrapped

_log = logging.getLogger(__name__)


def say(line: str) -> None:
    """Print a result; what does not fit in its line follows, indented. The log of the command has it as one line."""
    _log.info(line)
    typer.echo(wrapped(line, hanging="  "))
