"""What `init` asks in a terminal: the bone, the forces, the plate's directions. Enter skips a question."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import typer

from dvc.images.bone_names import is_bones_name
from mrstrain.studies.init import Answers, StudyInputs, force_named

Read = Callable[[str], str]
_T = TypeVar("_T")


def ask(inputs: StudyInputs, names: Sequence[str], picture: Path | str, *, read: Read = input) -> Answers:
    """Ask what the files do not tell, and give the answers; at the end of the input the rest is skipped.

    ``read`` shows a question and gives a line.
    """
    typer.echo(f"Picture of the images found: {picture}")
    typer.echo("Press Enter to accept the value in brackets; with [later], fill it in yourself in study.toml.")
    given: dict[str, Any] = {}
    usual = Answers()
    try:
        given |= _bone(inputs, names, read)
        forces: dict[str, tuple[float, float]] = {}
        given["forces"] = forces
        for load in inputs.loads:
            named = force_named(load)
            usual_n = "later" if named is None else f"{named:g}"
            pressed = _asked(f"{load}: normal force, N", usual_n, _force, read) or named
            if pressed is not None:
                forces[load] = pressed, _asked(f"{load}: shear force, N", "0", _number, read) or 0.0
        if inputs.loads:
            normal = "Direction from the body to the plate, LPS (x left, y posterior, z superior)"
            given["normal"] = _asked(normal, _words(usual.normal), _direction, read)
        if any(shear for _, shear in forces.values()):
            shear = "Direction of the shear force on the tissue, LPS"
            given["shear_direction"] = _asked(shear, _words(usual.shear_direction), _direction, read)
    except EOFError:
        typer.echo("")
    return replace(usual, **{name: answer for name, answer in given.items() if answer is not None})


def _bone(inputs: StudyInputs, names: Sequence[str], read: Read) -> dict[str, object]:
    """The bone, as the name of a label or the file of a mask."""
    files = [name for name in (inputs.bone_mask, *inputs.unused) if name is not None]
    likely = [name for name in sorted(names, key=lambda name: name != "bone") if is_bones_name(name)]
    if not names and not files:
        return {}

    def known(text: str) -> dict[str, object]:
        if text in names:
            return {"bone": text}
        if text in files:
            return {"bone_mask": text}
        raise ValueError(f"choose one of {', '.join([*names, *files])}")

    usual = inputs.bone_mask or next(iter(likely), "later")
    label = f"Which label is the bone ({', '.join(names)}), or which file is its mask?"
    told = _asked(label if names else "Which file is the mask of the bone?", usual, known, read)
    return told or ({"bone": usual} if usual in names else {})


def _asked(question: str, usual: str, understand: Callable[[str], _T], read: Read) -> _T | None:
    """An answer that is understood, asked for again until it is; None for Enter."""
    while True:
        text = read(f"{question} [{usual}]: ").strip()
        if not text:
            return None
        try:
            return understand(text)
        except ValueError as wrong:
            typer.echo(f"  '{text}': {wrong}.")


def _number(text: str) -> float:
    try:
        number = float(text.removesuffix("N").strip().replace(",", "."))
    except ValueError:
        number = float("nan")
    if not abs(number) < float("inf"):
        raise ValueError("a number is needed, such as 140")
    return number


def _force(text: str) -> float:
    number = _number(text)
    if number <= 0.0:
        raise ValueError("the normal force must be positive (compression)")
    return number


def _direction(text: str) -> tuple[float, float, float]:
    numbers = tuple(_number(part) for part in text.strip("[]()").replace(",", " ").split())
    if len(numbers) != 3 or not any(numbers):
        raise ValueError("three numbers are needed, such as 0 0 -1")
    return numbers[0], numbers[1], numbers[2]


def _words(direction: Sequence[float]) -> str:
    return " ".join(f"{value:g}" for value in direction)
