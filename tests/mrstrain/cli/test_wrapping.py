"""Lines for a terminal."""

from __future__ import annotations

import os
import shlex
import subprocess

import pytest

from mrstrain.cli.wrapping import wrapped


@pytest.mark.skipif(os.name == "nt", reason="commands are not broken on Windows")
def test_a_command_in_several_lines_is_the_same_command() -> None:
    command = "mrstrain register heel/Load0.nii.gz heel/Load1.nii.gz --bone 'heel/my calcaneus.nii.gz' " + " ".join(
        f"--option-{n} '/a folder/with spaces/and a long name/{n}'" for n in range(4)
    )
    lines = wrapped(command, "  ").splitlines()
    assert len(lines) > 2
    assert all(line.endswith(" \\") for line in lines[:-1])
    assert max(map(len, lines)) <= 100
    told = subprocess.run(
        ["sh", "-c", "printf '%s\\n' " + "\n".join(lines)], capture_output=True, text=True, check=True
    )
    assert told.stdout.splitlines() == shlex.split(command)


def test_words_about_commands_are_broken_as_words() -> None:
    told = "To measure it, type mrstrain register and the names of the images, " * 3
    assert "\\" not in wrapped(told)
    assert "\\" not in wrapped("mrstrain run makes them again. It keeps what is finished, with the same options. " * 2)
    assert wrapped("mrstrain check study") == "mrstrain check study"
