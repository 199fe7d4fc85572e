"""Does the wheel work where nothing else is? `make clean-install`; it needs the package registry, and some minutes.

The wheel is built, and installed with the pinned dependencies in a new environment, in a folder whose name has spaces
and letters beyond ASCII. Then the commands run from another such folder: without the repository, without a display,
with a home folder and an installation that nobody can write to, and without a locale.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_PINNED = re.compile(r"^([\w.-]+==[^\s\\]+(?: ; [^\\]+)?)", re.MULTILINE)
_FOLDER = "Füße und Ünïcode ≤1"
# Root is stopped by no permission; without its capabilities it is, as everybody else.
_AS_ANYBODY = ["setpriv", "--bounding-set", "-all", "--inh-caps", "-all"]
_OWN = """
import pathlib, sys
for name in ("dvc", "fe", "phantoms", "validate", "mrstrain"):
    place = pathlib.Path(__import__(name).__file__)
    assert place.is_relative_to(sys.prefix), place
import dvc, fe, phantoms, validate
assert dvc.read_image and fe.LoadStep and phantoms.Heel and validate.compare
try:
    (pathlib.Path(dvc.__file__).parent / "new").touch()
except PermissionError:
    print("the installation is read-only")
"""
_LABELS, _NAMES = "{there}/heel/tissues.nii.gz", ["--names", "{there}/heel/tissues.csv"]
_COMMANDS: tuple[tuple[list[str], str], ...] = (
    ([], "mrstrain demo"),
    (["--version"], "mrstrain 0"),
    (["doctor"], "ok   package names"),
    (["phantom", "--out", "{there}/heel", "--load", "Load1", "--spacing", "2.0"], ""),
    (["register", "{there}/heel/Load0.nii.gz", "{there}/heel/Load1.nii.gz", "--bone", "{there}/heel/calcaneus.nii.gz",
      "--labels", _LABELS, *_NAMES, "--out", "{there}/measured", "--workers", "1", "--threads", "1"], "report.html"),
    (["mesh", "{there}/heel/tissues_to_mesh.nii.gz", "--names", "{there}/heel/tissues_to_mesh.csv", "--edge-mm", "6",
      "--out", "{there}/mesh.vtu"], ""),
    (["simulate", "{there}/mesh.vtu", "--set", "akrami", "--load", "Load1=2",
      "--out", "{there}/simulated"], ""),
)  # fmt: skip
_RESULTS = ("heel/Load1.nii.gz", "measured/report.html", "measured/Load1/max_shear.nii.gz", "mesh.vtu")


def main() -> int:
    """Exit status 0 if every command did what it should."""
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as base:
        folder = Path(base) / _FOLDER
        try:
            return trials(folder, installed(folder / "environment"))
        finally:
            _writable(folder, True)


def installed(environment: Path) -> Path:
    """The interpreter of a new environment with the wheel of this checkout and the dependencies of the lock."""
    venv.create(environment, with_pip=True, clear=True)
    python = environment / "bin" / "python"
    pins = environment / "pins.txt"
    pins.write_text("\n".join(_PINNED.findall((ROOT / "requirements.lock").read_text())))
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(environment)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = environment.glob("mrstrain-*.whl")
    pip = [str(python), "-m", "pip", "install", "--disable-pip-version-check", "--quiet", "--only-binary", ":all:"]
    subprocess.run([*pip, "--constraint", str(pins), str(wheel)], check=True, cwd=environment)
    return python


def trials(folder: Path, python: Path) -> int:
    """Run the commands as somebody who can write to nothing but the folder of the results."""
    there, home = folder / "Ergebnisse für Ω", folder / "home"
    there.mkdir(parents=True)
    home.mkdir()
    for place in (home, python.parents[1]):
        _writable(place, False)
    environment = {"PATH": os.environ["PATH"], "HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    before = _AS_ANYBODY if os.name == "posix" and os.getuid() == 0 else []
    failed = 0
    commands = [([str(python), "-P", "-c", _OWN], "the installation is read-only")]
    commands += [
        ([str(python.parent / "mrstrain"), *(word.format(there=there) for word in words)], told)
        for words, told in _COMMANDS
    ]
    for command, told in commands:
        began = time.monotonic()
        done = subprocess.run(
            [*before, *command], cwd=there, env=environment, check=False, capture_output=True, text=True,
            encoding="utf-8",
        )  # fmt: skip
        good = done.returncode == 0 and told in done.stdout and not re.search("Traceback|Warning|Error", done.stderr)
        what = " ".join(["mrstrain", *command[1:2]]) if command[0].endswith("mrstrain") else "import"
        print(f"{'ok  ' if good else 'NOT '} {what}: {time.monotonic() - began:.0f} s", flush=True)
        if not good:
            failed += 1
            print(f"exit status {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}", flush=True)
    lacking = [name for name in _RESULTS if not (there / name).is_file()]
    for name in lacking:
        print(f"NOT  {name} is missing")
    return int(bool(failed or lacking))


def _writable(folder: Path, writable: bool) -> None:
    """Let or forbid everybody to write to a folder and all that is in it."""
    for place in (folder, *folder.rglob("*")):
        if not place.is_symlink():
            mode = place.stat().st_mode
            place.chmod(mode | 0o200 if writable else mode & ~0o222)


if __name__ == "__main__":
    sys.exit(main())
