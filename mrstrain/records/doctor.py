"""Checks whether this machine and environment are suitable for a run.

Only the standard library is imported here: another distribution may own the name ``dvc`` or ``validate``, which is the
first thing to check.
"""

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

_OURS = ("dvc", "fe", "phantoms", "validate", "mrstrain")
# Distributions known to install a package with one of our names, and what else they are called.
_RIVALS = {"dvc": ("dvc", " (Data Version Control)"), "configobj": ("validate", " (ConfigObj)")}
_RIVALS["validate"] = ("validate", "")
_NEEDED = (
    "itk-elastix", "SimpleITK", "numpy", "scipy", "scikit-image", "meshio", "nibabel", "isal", "pydicom", "numba",
    "matplotlib", "jinja2", "pillow", "lazy-loader", "rich", "typer", "loky", "distributed", "filelock", "pydantic",
    "pytetwild", "pyvista", "vtk", "psutil",
)  # fmt: skip
_ELASTIX = "0.25."  # the series that parameters are checked against
_OLDEST_PYTHON = (3, 11)
_GIB = 1024**3
_CONTAINER = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_LEAST_MEMORY_GIB = 6.0  # a pair of 256^3 images
_LEAST_DISK_GIB = 2.0  # results of one loaded image of that size
_SLOW_S = 60.0  # trials take seconds


class ForeignPackageError(ImportError):
    """A package with one of our names belongs to another distribution.

    An ImportError, not a `dvc.errors.MrstrainError`, because ``dvc`` may be the foreign package.
    """


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check: what was checked, whether it meets the needs of a run, and advice where it does not."""

    what: str
    ok: bool
    detail: str  # version, size or place found
    advice: str = ""


def examine(
    folder: str | os.PathLike[str] = ".", *, trials: Mapping[str, Callable[[], str]] | None = None
) -> list[Finding]:
    """Check everything that a run depends on, in the order in which problems are best solved.

    A failed check does not stop the others. ``folder`` is to hold results: the disk of its nearest existing parent is
    checked. ``trials`` are short trial runs by name; each returns a line on how it went, or raises.
    """
    foreign = " ".join(_foreign_packages())
    detail = foreign or f"{', '.join(_OURS)} belong to mrstrain"
    own = Finding("package names", not foreign, detail, "Install mrstrain in an environment of its own.")
    findings = [_python(), own, *map(_package, _NEEDED), _cores(), _memory(), _disk(Path(folder)), _temporary()]
    return [*findings, *(_tried(what, trial) for what, trial in (trials or {}).items())]


def refuse_foreign_packages() -> None:
    """Raise ForeignPackageError where one of our package names belongs to another distribution; takes milliseconds.

    Either the name resolves to a foreign location, or a distribution that installs into the same folder is present
    (whichever was installed later overwrote files of the other).
    """
    if reasons := _foreign_packages():
        raise ForeignPackageError(
            f"{' '.join(reasons)} Install mrstrain in an environment of its own: python -m venv mrstrain-env, and "
            "install it there."
        )


def _foreign_packages() -> list[str]:
    home = Path(__file__).resolve().parents[2]
    reasons: dict[str, str] = {}  # one for each package
    for name, (package, title) in _RIVALS.items():
        try:
            rival = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        if _brings(rival, package):
            reasons[package] = (
                f"The distribution {name}{title} {rival.version} is installed in the same environment, and its package "
                f"{package!r} has the same name as one of mrstrain."
            )
    for package in (one for one in _OURS if one not in reasons):
        try:
            spec = importlib.util.find_spec(package)
        except ValueError:  # a module in sys.modules without a spec
            spec = None
        places = [Path(place).resolve() for place in spec.submodule_search_locations or ()] if spec else []
        if home / package not in places:
            found = f"found in {spec.origin}" if spec and spec.origin else "not found"
            reasons[package] = f"The package {package!r} should be in {home}, but is {found}."
    return list(reasons.values())


def _brings(distribution: importlib.metadata.Distribution, package: str) -> bool:
    files = distribution.files
    if files is None:  # no record of files: some system packages
        return package in (distribution.read_text("top_level.txt") or package).split()
    return any(file.parts[0] in {package, f"{package}.py"} for file in files)


def _python() -> Finding:
    new, of_64_bits = sys.version_info[:2] >= _OLDEST_PYTHON, sys.maxsize > 2**32
    detail = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    detail += "" if of_64_bits else ", 32 bit"
    return Finding("Python", new and of_64_bits, detail, "Install a 64-bit Python, 3.11 or newer.")


def _package(name: str) -> Finding:
    ours = name == "itk-elastix"
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        wheels = "; wheels: Linux (glibc 2.28), macOS 15 on Apple silicon, Windows x64" if ours else ""
        return Finding(name, False, "not installed", f"pip install {name}{wheels}")
    advice = f"pip install 'itk-elastix=={_ELASTIX}*' (parameter names are checked against this version)."
    return Finding(name, not ours or version.startswith(_ELASTIX), version, advice)


def _cores() -> Finding:
    try:
        count = len(os.sched_getaffinity(0))  # what this process may use, not what the machine has
    except AttributeError:
        count = os.cpu_count() or 1
    return Finding("processor cores", True, str(count))


def _memory() -> Finding:
    total = usable_memory_bytes()
    if total is None:
        return Finding("memory", True, "not known on this system")
    needed = f"A pair of 256 x 256 x 256 voxels takes up to {_LEAST_MEMORY_GIB:.0f} GiB"
    advice = f"{needed}. Crop the images, or use a machine with more memory."
    return Finding("memory", total >= _LEAST_MEMORY_GIB * _GIB, f"{total / _GIB:.1f} GiB", advice)


def usable_memory_bytes() -> int | None:
    """Memory that this process may use, bytes: the machine's, or the limit of its container; None without psutil."""
    if importlib.util.find_spec("psutil") is None:
        return None
    import psutil

    limits = [Path(file).read_text().strip() for file in _CONTAINER if os.access(file, os.R_OK)]
    return min([int(psutil.virtual_memory().total), *(int(limit) for limit in limits if limit.isdigit())])


def _disk(folder: Path) -> Finding:
    existing = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.exists())
    if not os.access(existing, os.W_OK):
        return Finding("disk", False, f"{existing} is not writable", "Choose another folder for the results.")
    free, needed = shutil.disk_usage(existing).free, f"Results of one loaded image take up to {_LEAST_DISK_GIB:.0f} GiB"
    advice = f"{needed}. Free disk space, or choose another folder."
    return Finding("disk", free >= _LEAST_DISK_GIB * _GIB, f"{free / _GIB:.1f} GiB free for results", advice)


def _temporary() -> Finding:
    try:
        with tempfile.TemporaryFile() as file:
            file.write(b"0" * 4096)
            file.flush()
    except OSError as error:
        return Finding("temporary folder", False, str(error), "Set TMPDIR to a writable folder.")
    return Finding("temporary folder", True, f"{tempfile.gettempdir()} is writable")


def _tried(what: str, trial: Callable[[], str]) -> Finding:
    began = monotonic()
    try:
        detail = trial()
    except Exception as error:  # must not end the examination
        advice = "The line above is the error of the trial. Reinstall mrstrain in an environment of its own."
        return Finding(f"trial of {what}", False, f"{type(error).__name__}: {error}", advice)
    if (took_s := monotonic() - began) > _SLOW_S:
        detail += f"; it took {took_s:.0f} s, which is slow: other programs may keep the machine busy"
    return Finding(f"trial of {what}", True, detail)
