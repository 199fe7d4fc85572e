"""What a package offers at its front door is taken from there, by the other packages, the benchmarks and the pages."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("dvc", "fe", "phantoms", "validate", "mrstrain")
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


def sources(folders: tuple[str, ...]) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def inner_names(source: str) -> Iterator[tuple[str, str]]:
    """Module and name of everything that is taken from an inner file: imported by name, or by `module.name`."""
    tree = ast.parse(source)
    modules = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                whole = alias.name if alias.asname else package_of(alias.name)
                modules[alias.asname or whole] = whole
        if isinstance(node, ast.ImportFrom) and node.module and package_of(node.module) in PACKAGES:
            for alias in node.names:
                if node.module in PACKAGES and alias.name in names_at(node.module):
                    continue
                if is_module(whole := f"{node.module}.{alias.name}"):
                    modules[alias.asname or alias.name] = whole
                else:
                    yield node.module, alias.name
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            head, dot, rest = ast.unparse(node.value).partition(".")
            module = modules.get(head, "") + dot + rest
            if "." in module and package_of(module) in PACKAGES and is_module(module):
                yield module, node.attr


def package_of(module: str) -> str:
    return module.split(".", maxsplit=1)[0]


def names_at(package: str) -> list[str]:
    return getattr(import_module(package), "__all__", [])


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def offered(module: str, name: str) -> bool:
    """Whether the front door of the module's package has the very thing."""
    package = package_of(module)
    return name in names_at(package) and getattr(import_module(package), name) is getattr(import_module(module), name)


def past_the_door(source: str, package: str) -> set[tuple[str, str]]:
    """What a file of a package takes from inner files of the others although their front doors have it."""
    return {
        (module, name)
        for module, name in inner_names(source)
        if package_of(module) != package and offered(module, name)
    }


def test_packages_and_benchmarks_take_from_the_front_door_what_it_has() -> None:
    past = {
        (str(path.relative_to(ROOT)), module, name)
        for path in sources((*PACKAGES, "benchmarks"))
        for module, name in past_the_door(path.read_text(), path.relative_to(ROOT).parts[0])
    }
    assert not past, "\n".join(f"{file}: {module}.{name}" for file, module, name in sorted(past))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_import_nothing_from_inner_files(page: Path) -> None:
    blocks = [example.parsed for example in Sybil(parsers=[PythonCodeBlockParser()]).parse(page).examples()]
    assert not [name for block in blocks for name in inner_names(block)]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_front_door_offers_what_type_checkers_and_the_reference_are_told(package: str) -> None:
    door = import_module(package)
    told = ast.parse((ROOT / package / "__init__.pyi").read_text()).body[-1]
    assert isinstance(told, ast.Assign)
    assert sorted(ast.literal_eval(told.value)) == sorted(door.__all__)
    for name in door.__all__:
        value = getattr(door, name)
        assert inspect.getdoc(value) or not callable(value), name
    with pytest.raises(AttributeError, match="Hoof"):
        door.Hoof  # noqa: B018


def test_every_way_past_the_door_is_seen() -> None:
    ways = {
        "from dvc.images.image import Grid": {("dvc.images.image", "Grid")},
        "from dvc.images import image\nimage.Grid()": {("dvc.images.image", "Grid")},
        "from dvc.images import image as im\nim.Grid()": {("dvc.images.image", "Grid")},
        "import dvc.images.image\nx: dvc.images.image.Grid": {("dvc.images.image", "Grid")},
        "import dvc\ndvc.images.image.Grid": {("dvc.images.image", "Grid")},
        "def f():\n    from dvc.images.image import Grid as G": {("dvc.images.image", "Grid")},
        "from dvc import Grid\nimport dvc\ndvc.Grid": set(),
        "from dvc.arrays import FloatArray": set(),  # not offered
        "from numpy.linalg import norm": set(),
    }
    for source, past in ways.items():
        assert past_the_door(source, "fe") == past, source
        assert past_the_door(source, "dvc") == set()
