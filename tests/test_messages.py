"""An error says what is wrong, where, why, and what to do next, in at most three lines of 100 characters."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

import dvc.errors
import mrstrain
from mrstrain.cli.app import app, main
from mrstrain.cli.wrapping import wrapped

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("dvc", "fe", "validate", "phantoms", "mrstrain")
HOLE = "x" * 12
"""Stands for what a message takes from the data: a path, a number, a name."""
LONGEST, LINES = 300, 3
DEEPEST = 6  # of what a text is made from
BROKEN = re.compile(r"damaged|incomplete|diverged|no such file|is empty")
STEP = re.compile(
    r"\b(export|copy|check|register|write|run|give|save|choose|start|use|restore|delete|compare|pass|look|repair|add)\b",
    re.IGNORECASE,
)
"""What a person can do next."""
LIST = f":\n{HOLE}"  # choices may follow below a message, a line for each
TEXTS = ("InputError", "ImageFileError")  # returned by functions that make an error


def sources() -> dict[str, ast.Module]:
    """Every module of the packages, by its place."""
    paths = [path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))]
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in paths}


def project_errors(modules: list[ast.Module]) -> set[str]:
    """Names of the classes of dvc.errors and of their subclasses in any module."""
    names = {name for name, one in vars(dvc.errors).items() if isinstance(one, type)}
    classes = [node for module in modules for node in ast.walk(module) if isinstance(node, ast.ClassDef)]
    while more := {c.name for c in classes if names & {ast.unparse(base).split(".")[-1] for base in c.bases}} - names:
        names |= more
    return names


class Text:
    """The longest text that an expression can have, as far as the sources tell; data are holes of 12 characters."""

    def __init__(self, modules: list[ast.Module]) -> None:
        functions = [node for module in modules for node in ast.walk(module) if isinstance(node, ast.FunctionDef)]
        self.functions: dict[str, list[ast.FunctionDef]] = {}
        for function in functions:
            if ast.unparse(function.returns or ast.Constant(None)) in ("str", *TEXTS):
                self.functions.setdefault(function.name, []).append(function)

    def of(self, node: ast.expr, within: list[ast.FunctionDef], depth: int = 0) -> str:
        """The text of an expression in nested functions, the innermost last."""

        def inner(part: ast.expr) -> str:
            return self.of(part, within, depth + 1)

        choices: list[str] = []
        if isinstance(node, ast.Constant):
            return str(node.value)
        if depth > DEEPEST:
            return HOLE
        if isinstance(node, ast.JoinedStr):
            return "".join(inner(v.value if isinstance(v, ast.FormattedValue) else v) for v in node.values)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            return inner(node.left) + inner(node.right)
        if isinstance(node, ast.IfExp):
            choices = [inner(node.body), inner(node.orelse)]
        elif isinstance(node, ast.Name) and within:
            choices = [inner(value) for value in assigned(node.id, within[-1])]
            return max(choices, key=len, default=HOLE) + "".join(map(inner, added(node.id, within[-1])))
        elif isinstance(node, (ast.Call, ast.Attribute)):
            name = ast.unparse(node.func if isinstance(node, ast.Call) else node).split(".")[-1]
            if name == "few" and isinstance(node, ast.Call):
                return listed(node)
            of = self.functions.get(name, []) if name != "name" else []
            choices = [self.of(value, [function], depth + 1) for function in of for value in returned(function)]
        return max(choices, key=len, default=HOLE)


def listed(node: ast.Call) -> str:
    """The longest list that `dvc.errors.few` makes."""
    most = [one.value.value for one in node.keywords if one.arg == "most" and isinstance(one.value, ast.Constant)]
    return dvc.errors.few([HOLE] * 99, *most)


def assigned(name: str, within: ast.FunctionDef) -> Iterator[ast.expr]:
    """What a name is set to in a function, by itself or in a row of names."""
    for node in ast.walk(within):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                rows = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                pairs = zip(target.elts, node.value.elts, strict=True) if rows else [(target, node.value)]
                yield from (value for one, value in pairs if getattr(one, "id", "") == name)
        elif isinstance(node, ast.NamedExpr) and node.target.id == name:
            yield node.value


def added(name: str, within: ast.FunctionDef) -> Iterator[ast.expr]:
    """What is added to a name in a function."""
    for node in ast.walk(within):
        if isinstance(node, ast.AugAssign) and getattr(node.target, "id", "") == name:
            yield node.value


def returned(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """What a function returns."""
    for node in ast.walk(function):
        if isinstance(node, ast.Return) and node.value is not None:
            yield node.value


def messages() -> Iterator[tuple[str, str]]:
    """Every message of an error of the project, and where it is made."""
    modules = sources()
    names, text = project_errors([*modules.values()]), Text([*modules.values()])
    for place, module in modules.items():
        functions = [node for node in ast.walk(module) if isinstance(node, ast.FunctionDef)]
        for node in ast.walk(module):
            if isinstance(node, ast.Call) and node.args and ast.unparse(node.func).split(".")[-1] in names:
                within = [f for f in functions if f.lineno <= node.lineno <= (f.end_lineno or 0)]
                yield f"{place}:{node.lineno}", text.of(node.args[0], within)


def test_no_error_is_longer_than_three_lines() -> None:
    found = dict(messages())
    assert len(found) > 400
    assert sum(len(message) > 100 for message in found.values()) > 100  # the texts themselves are seen
    long = [
        f"{place}: {len(message)} characters: {message}"
        for place, message in found.items()
        for text in [f"mrstrain: {message.removesuffix(LIST)}"]
        if len(text) > LONGEST or len(wrapped(text).splitlines()) > LINES
    ]
    assert not long, "\n" + "\n".join(long)


def test_what_is_damaged_missing_or_diverged_comes_with_a_next_step() -> None:
    """The messages of a chain of causes end where they are raised again, by a hole."""
    without = [
        f"{place}: {message}"
        for place, message in messages()
        if BROKEN.search(message) and not STEP.search(message) and not message.endswith(HOLE)
    ]
    assert not without, "\n" + "\n".join(without)
    assert BROKEN.search("the header is damaged.")
    assert not STEP.search("the header is damaged.")


def test_a_message_is_taken_together_from_its_parts() -> None:
    module = ast.parse(
        "def told(a) -> str:\n"
        "    return f'{a}, and so on' if a else 'no'\n"
        "def check(path):\n"
        "    where = 'here'\n"
        "    where += ' and there'\n"
        "    raise InputError(f'{path}: ' + told(path) + f' {where}')\n"
    )
    check = module.body[1]
    assert isinstance(check, ast.FunctionDef)
    assert isinstance(check.body[2], ast.Raise)
    assert isinstance(check.body[2].exc, ast.Call)
    assert Text([module]).of(check.body[2].exc.args[0], [check]) == f"{HOLE}: {HOLE}, and so on here and there"


def test_an_error_is_printed_in_lines_broken_between_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    place = "/data/" + "a-long-name/" * 12 + "Load0.nii.gz"
    told = [f"{place}: no such file.", "Use another " + "file-name " * 20 + "please.", "  one: " + "of them " * 20]

    def fails() -> None:
        raise dvc.errors.InputError("\n".join(told))

    monkeypatch.setattr("mrstrain.cli.app.app", fails)
    monkeypatch.setattr("sys.argv", ["mrstrain"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert all(len(line) <= 100 or line.lstrip() == f"{place}:" for line in lines)
    assert " ".join(" ".join(lines).split()) == " ".join(f"mrstrain: {' '.join(told)}".split())
    assert [line.startswith("  ") for line in lines[-2:]] == [True, True]


def test_results_are_printed_in_lines_broken_between_words(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.nii", "b.nii"):
        Path(name).touch()
    report = "Report: /data/" + "a-long-name/" * 12 + "report.html"
    told = ["Load1: Use with care. " + "The bone moves 0.3 mm. " * 10, "  below it: " + "of them " * 20, report]

    class Done:
        def summary(self) -> list[str]:
            return told

    monkeypatch.setattr(mrstrain, "strain", type("", (), {"with_options": lambda *_, **__: Done()}))
    lines = CliRunner().invoke(app, ["strain", "a.nii", "b.nii", "--out", "c"]).output.splitlines()
    assert lines[-2:] == ["Report:", "  " + report.removeprefix("Report: ")]
    assert all(len(line) <= 100 for line in lines[:-1])
    assert " ".join(" ".join(lines).split()) == " ".join(" ".join(told).split())
    starts = [len(line) - len(line.lstrip()) for line in lines]
    assert starts == [0, 2, 2, 2, 4, 0, 2]  # what follows a line is indented below it
