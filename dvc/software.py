"""The software that a result depends on, as one key for everything that is kept to be used again.

Stages of a study, restart files of simulations and runs of an accuracy study are kept under this key, and made anew
when it changes. It covers every file of the package that computes the result and of those of ours that it imports, and
the versions of mrstrain and of the libraries that figures depend on. Whole packages, because a list of file names goes
stale without a warning, and following imports loses what is read by name (parameter files, material sets).
"""

import hashlib
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

_OURS = ("dvc", "fe", "phantoms", "validate", "mrstrain")
_IMPORTED = re.compile(rf"\n[ \t]*(?:from|import)[ \t]+({'|'.join(_OURS)})\b".encode())
_DISTRIBUTIONS = (
    "mrstrain", "itk-elastix", "SimpleITK", "numpy", "scipy", "scikit-image", "numba", "nibabel", "isal", "pydicom",
    "meshio", "pytetwild", "vtk", "pypardiso", "mkl", "ngsolve",
)  # fmt: skip


def distribution_versions() -> dict[str, str]:
    """Versions of mrstrain and of the libraries that figures depend on; "not installed" where there is none."""
    found = {}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


@cache
def software_key(package: str) -> str:
    """Versions, and a hash of our own code, that results of one of our packages ("dvc", "fe", ...) depend on."""
    hashes: dict[str, str] = {}
    waiting = [package]
    while waiting:
        name = waiting.pop()
        if name not in hashes:
            hashes[name], imported = _package(name)
            waiting.extend(imported)
    code = hashlib.sha256(repr(sorted(hashes.items())).encode()).hexdigest()[:12]
    own, *libraries = (" ".join(told) for told in distribution_versions().items())
    return ", ".join([own, f"code {code}", *libraries])


@cache
def _package(package: str) -> tuple[str, frozenset[str]]:
    """Hash of a package's files, and those of our packages that it imports anywhere, inside functions too."""
    folder = _folder(package)
    digest = hashlib.sha256()
    imported: set[str] = set()
    for name, file in sorted((file.relative_to(folder).as_posix(), file) for file in folder.rglob("*")):
        if any(part.startswith((".", "__pycache__")) for part in name.split("/")) or not file.is_file():
            continue
        content = file.read_bytes()
        digest.update(f"{name} {len(content)};".encode())
        digest.update(content)
        if file.suffix == ".py":
            imported.update(found.decode() for found in _IMPORTED.findall(b"\n" + content))
    return digest.hexdigest(), frozenset(imported)


def _folder(package: str) -> Path:
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"mrstrain is incomplete: its package '{package}' is missing. Install it again.")
    return Path(spec.submodule_search_locations[0])
