"""The record itself: of each quantity a hash of its bytes and figures for a person; and where results differ from it.

Figures are held on every machine, hashes bit for bit where processor and libraries are those that the record was made
with.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tests.golden.reading import Quantity

FOLDER = Path(__file__).parent / "record"
TOLERANCE = 1e-7
"""Of figures, over the quantity's root mean square; files that keep fewer digits are held to theirs (``_digits``)."""
ELSEWHERE = {"phantom": 1e-6} | dict.fromkeys(("smooth", "interfaces", "elastix", "study"), 1e-3)
"""The same on other machines than the record's, of maps in single precision and of scenes that register: iterations
that stop at a small step stop elsewhere. With instructions of another processor displacement moved by 1e-5, an
interval's share of volume by 3e-4."""
OF_FEW_CELLS = 1e-2
"""The same of strain-volume curves, which few cells make: one that passed a threshold moved such a curve by 5e-3."""
_PACKAGES = ("numpy", "scipy", "numba", "itk-elastix", "SimpleITK", "scikit-image", "pypardiso", "mkl")
_PERCENTILES = (5, 50, 95)
_FEW = 16
_NOTHING = 1e-9  # in any unit
_UNBALANCED = 1e-7  # N, N mm: the plate's forces and moments that should be zero are what the solver left

Figures = dict[str, Any]


def made_with() -> dict[str, str]:
    """The processor and the libraries that bits depend on."""
    try:
        told = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]  # of the first core
    except OSError:
        told = ""
    named = dict(re.findall(r"^(model name|cpu family|model|flags)\s*:\s*(.+)$", told, re.MULTILINE))
    flags = hashlib.sha256(named.pop("flags", "").encode()).hexdigest()[:12]  # a name may stand for several generations
    processor = " ".join([*(named.values() or [platform.processor(), platform.machine()]), "flags", flags])
    return {"processor": processor, "system": platform.system()} | {name: version(name) for name in _PACKAGES}


def figures_of(quantity: Quantity) -> Figures:
    """What is kept of a quantity."""
    if quantity.dtype.kind not in "biuf":
        words = quantity.ravel().astype(str).tolist()
        if quantity.size == 1:
            return {"word": words[0]}
        digest = hashlib.sha256("\n".join(words).encode()).hexdigest()
        return {"shape": list(quantity.shape), "words": sorted(set(words)), "sha256": digest}
    values = quantity.astype(np.float64).ravel()
    if values.size <= _FEW:
        return {"values": [None if np.isnan(v) else v for v in values.tolist()]}
    known = values[np.isfinite(values)]
    digest = hashlib.sha256(np.ascontiguousarray(quantity).tobytes()).hexdigest()
    kept: Figures = {"shape": list(quantity.shape), "sha256": digest, "known": known.size}
    if known.size == 0:
        return kept
    # Values weighted by where they stand: a figure that changes where two of them change places.
    weights = np.cos(np.arange(values.size, dtype=np.float64))[np.isfinite(values)]
    named = dict(zip((f"p{p:02d}" for p in _PERCENTILES), np.percentile(known, _PERCENTILES).tolist(), strict=True))
    return kept | {
        "min": known.min().item(), **named, "max": known.max().item(), "mean": known.mean().item(),
        "rms": np.sqrt(np.mean(known**2)).item(), "by_place": np.mean(known * weights).item(),
    }  # fmt: skip


def write_record(scene: str, found: Mapping[str, Quantity]) -> None:
    """Keep what a scene gave: a line for each quantity."""
    rows = {name: figures_of(quantity) for name, quantity in found.items()}
    lines = [f"{json.dumps(name)}: {json.dumps(row, allow_nan=False)}" for name, row in rows.items()]
    text = "{\n" + f'"made with": {json.dumps(made_with())},\n"quantities": {{\n' + ",\n".join(lines) + "\n}\n}\n"
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{scene}.json").write_text(text, encoding="utf-8")


def read_record(scene: str) -> tuple[dict[str, str], dict[str, Figures]]:
    """What a scene's record was made with, and its quantities."""
    told = json.loads((FOLDER / f"{scene}.json").read_text(encoding="utf-8"))
    return told["made with"], told["quantities"]


def check(scene: str, found: Mapping[str, Quantity]) -> tuple[list[str], str]:
    """How results differ from a scene's record, and a sentence on whether its hashes counted."""
    made, kept = read_record(scene)
    here = made_with()
    others = [f"{name} {made[name]}, here {here[name]}" for name in made if made[name] != here.get(name)]
    tolerance = ELSEWHERE.get(scene, TOLERANCE) if others else TOLERANCE
    wrong = differences(kept, found, bits=not others, tolerance=tolerance)
    compared = "figures and hashes" if not others else f"figures alone, no hashes (made with {'; '.join(others)})"
    return wrong, f"{len(kept)} quantities, {compared}: {len(wrong) or 'none'} differ"


def differences(
    kept: Mapping[str, Figures], found: Mapping[str, Quantity], *, bits: bool, tolerance: float = TOLERANCE
) -> list[str]:
    """A sentence for each quantity that is not as it was; with ``bits`` its hash counts too."""
    gone = [f"{name}: is no more" for name in kept if name not in found]
    new = [f"{name}: is not in the record" for name in found if name not in kept]
    changed = (_difference(name, kept[name], found[name], bits, tolerance) for name in kept if name in found)
    return [*gone, *new, *(one for one in changed if one)]


def _difference(name: str, kept: Figures, quantity: Quantity, bits: bool, tolerance: float) -> str:
    found = figures_of(quantity)
    exact = ("shape", "known", "word", "words")
    for key in (*exact, *(("sha256",) if "words" in kept else ())):
        if kept.get(key) != found.get(key):
            return f"{name}: {key} was {kept.get(key)}, is {found.get(key)}"
    if "values" in kept:
        if len(kept["values"]) != len(found.get("values", ())):
            return f"{name}: were {kept['values']}, are {found.get('values', 'none of few')}"
        if bits and kept != found:
            return f"{name}: were {kept['values']}, are {found['values']}, to the last bit"
    scale = kept.get("rms", _rms(kept.get("values", ())))
    for key, was, now in _pairs(kept, found):
        least = OF_FEW_CELLS if tolerance > TOLERANCE and "curves.csv" in name else 0.0
        allowed = max(tolerance, least) * scale + _digits(name, quantity) * abs(was or 0.0) + _nothing(name)
        if (was is None) != (now is None) or (was is not None and not abs(now - was) <= allowed):
            return f"{name}: {key} was {was!r}, is {now!r} (may differ by {allowed:.1e})"
    if bits and kept.get("sha256") != found.get("sha256"):
        return f"{name}: its figures hold, its bits do not"
    return ""


def _pairs(kept: Figures, found: Figures) -> Sequence[tuple[str, float | None, float | None]]:
    if "values" in kept:
        both = enumerate(zip(kept["values"], found["values"], strict=True))
        return [(f"value {number}", was, now) for number, (was, now) in both]
    return [(key, kept[key], found[key]) for key in kept if isinstance(kept[key], float)]


def _digits(name: str, quantity: Quantity) -> float:
    """The last digit that is kept, over the number: a result that moves less may still be rounded to another."""
    if ".csv:" in name:
        return 1e-5
    return float(np.finfo(quantity.dtype).eps) if quantity.dtype.kind == "f" else 0.0


def _nothing(name: str) -> float:
    return _UNBALANCED if re.search(r"force_|_moment_|: moment_", name) else _NOTHING


def _rms(values: Sequence[float | None]) -> float:
    known = [v for v in values if v is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else 0.0
