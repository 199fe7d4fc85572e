"""Results of a command, on standard output."""

import typer

from mrstrain.cli.wrapping import wrapped


def say(line: str) -> None:
    """Print a result; what does not fit in its line follows, indented."""
    typer.echo(wrapped(line, hanging="  "))
