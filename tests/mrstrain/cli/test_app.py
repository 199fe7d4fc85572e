"""The program as a person first meets it."""

from __future__ import annotations

import re

from typer.testing import CliRunner

from mrstrain.cli.app import app


def test_without_arguments_it_greets_with_three_commands_and_not_with_the_whole_help() -> None:
    ran = CliRunner().invoke(app, [])
    assert ran.exit_code == 0
    assert re.findall(r"^  mrstrain (\w+)", ran.output, re.MULTILINE) == ["demo", "register", "compare"]
    assert "mrstrain --help" in ran.output
    assert len(ran.output.splitlines()) < 10
    assert "converge" in CliRunner().invoke(app, ["--help"]).output


def test_a_command_does_not_greet_and_one_that_there_is_not_is_refused() -> None:
    assert CliRunner().invoke(app, ["--version"]).output.startswith("mrstrain 0")
    assert "mrstrain demo" not in CliRunner().invoke(app, ["fit", "--help"]).output
    assert CliRunner().invoke(app, ["registr"]).exit_code == 2
