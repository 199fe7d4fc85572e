"""Material parameter sets, tissue by tissue: seven published ones, and the user's own in the same form."""

import difflib
import inspect
import json
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

from dvc.errors import InputError
from fe.hyperelastic import OGDEN
from fe.materials import Hencky, Material, Materials, NeoHooke, Ogden, Yeoh

WHOLE = "all"
"""Name of the tissue in a set that has one material law for everything."""

_INSTEAD = {"tendon": ("muscle", "fat"), "aponeurosis": ("muscle", "fat"), "muscle": ("fat",)}


_Constructor = Callable[..., Material]  # its parameters are the numbers that a file gives; stresses end in _mpa
_LAWS: Mapping[str, _Constructor] = {"neo-Hooke": NeoHooke.of, "Yeoh": Yeoh.of, "linear elastic": Hencky.of}
_OGDEN: Mapping[str, _Constructor] = {
    "ansys": Ogden.from_ansys, "abaqus": Ogden.from_abaqus, "febio": Ogden.from_febio
}  # by convention  # fmt: skip
_TO_MPA = {"_mpa": 1.0, "_kpa": 1e-3}


@dataclass(frozen=True, slots=True, eq=False)
class MaterialSet:
    """A material parameter set: a constitutive model with its parameters for each tissue.

    Attributes
    ----------
    name, title, source : str
        Short name, who proposed it, and where the numbers are printed.
    materials : mapping of tissue to Material
        "all" where one serves every tissue.
    """

    name: str
    title: str
    source: str
    materials: Materials

    def for_regions(self, regions: Iterable[str]) -> tuple[dict[str, Material], tuple[str, ...]]:
        """The material law of each region of a mesh, and a sentence for each region that has none of its own.

        Tendon and aponeurosis without one take muscle's, or else fat's; muscle takes fat's. No other region takes
        another's.

        Raises
        ------
        InputError
            If a region has no material law and the set none to put in its place.

        Examples
        --------
        >>> materials, notes = material_set("friedman").for_regions(["fat", "skin", "muscle"])
        >>> materials["muscle"] is materials["fat"], notes
        (True, ("friedman has no material law for muscle; fat's is used.",))
        """
        by_region, notes = dict[str, Material](), []
        if WHOLE in self.materials:
            return dict.fromkeys(regions, self.materials[WHOLE]), ()
        known = {tissue.casefold(): law for tissue, law in self.materials.items()}
        for region in regions:
            tried = (region, *_INSTEAD.get(region.casefold(), ()))
            name = next((t for t in tried if t.casefold() in known), None)
            if name is None:
                instead = f", nor one for {' or '.join(tried[1:])} to put in its place" if tried[1:] else ""
                raise InputError(
                    f"The set {self.name} has no material law for the region '{region}'{instead}; it has "
                    f"{', '.join(self.materials)}. Add it to the set in a file of your own, or rename the region."
                )
            by_region[region] = known[name.casefold()]
            if name != region:
                notes.append(f"{self.name} has no material law for {region}; {name}'s is used.")
        return by_region, tuple(notes)


def published_names() -> list[str]:
    """Names of the sets that come with mrstrain."""
    return list(_published())


def material_set(name: str | Path) -> MaterialSet:
    """A published set by its name, or the only set of a user's file by its path (.toml).

    Raises
    ------
    InputError
        If there is no set of that name, or the file cannot be used.

    Examples
    --------
    >>> material_set("erdemir").materials["all"].description
    'Ogden, mu0 56.09 kPa, alpha 6.82, nu 0.49'
    """
    if str(name).endswith(".toml"):
        sets = read_material_sets(name)
        if len(sets) > 1:
            raise InputError(f"{name} holds {len(sets)} sets ({', '.join(sets)}); split it, or read them all.")
        return next(iter(sets.values()))
    known = _published()
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        hint = f"; the nearest is '{near[0]}'" if near else ""
        raise InputError(f"No material set '{name}'{hint}. There are {', '.join(known)}; or give a file (.toml).")
    return known[str(name)]


def as_material_set(given: MaterialSet | Materials | Path | str) -> MaterialSet:
    """A set as it is, by its name or file, or of materials by region."""
    if isinstance(given, (str, Path)):
        return material_set(given)
    return given if isinstance(given, MaterialSet) else MaterialSet("materials", "", "", dict(given))


def read_material_sets(path: str | Path) -> dict[str, MaterialSet]:
    """Every set of a file, by name; the form is that of ``fe/published.toml``.

    Raises
    ------
    InputError
        If the file cannot be read, a key is unknown or missing, or a number is out of range; with file, set and tissue.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as failure:
        raise InputError(f"Cannot read the material sets {path}: {failure}.") from failure
    return _parsed(str(path), text)


def as_toml(name: str, title: str, materials: Materials) -> str:
    """A set as text in the form that `read_material_sets` takes; Ogden's numbers in the convention of Abaqus.

    Examples
    --------
    >>> print(as_toml("mine", "Ours", {"fat": Ogden.of(0.0105, 6.2)}), end="")
    [mine]
    title = "Ours"
    <BLANKLINE>
    [mine.fat]
    law = "Ogden"
    convention = "abaqus"
    mu_mpa = [0.0105]
    alpha = [6.2]
    nu = 0.4999
    """
    key = _key(name)
    lines = [f"[{key}]", f"title = {json.dumps(title)}"]
    for tissue, law in materials.items():
        lines += ["", f"[{key}.{_key(tissue)}]"]
        lines += [f"{k} = {v}" for k, v in _numbers_of(law).items()]
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else json.dumps(name)


def _numbers_of(law: Material) -> dict[str, object]:
    """The name and numbers of a material law as a file has them."""
    numbers: dict[str, object] = {f"{name.lower()}_mpa": value for name, value in law.moduli_mpa.items()}
    if isinstance(law, Ogden):
        mu, alpha = law.vector[OGDEN::2].tolist(), law.vector[OGDEN + 1 :: 2].tolist()
        numbers = {"convention": '"abaqus"', "mu_mpa": mu, "alpha": alpha}
    return {"law": json.dumps(law.law.removesuffix(" (Hencky)"))} | numbers | {"nu": law.nu}


@cache
def _published() -> dict[str, MaterialSet]:
    return _parsed("published.toml", (files("fe") / "published.toml").read_text(encoding="utf-8"))


def _parsed(where: str, text: str) -> dict[str, MaterialSet]:
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as failure:
        raise InputError(f"{where}: not a TOML file: {failure}.") from failure
    sets = {}
    for name, content in tables.items():
        if not isinstance(content, dict):
            raise InputError(f"{where}: '{name}' is outside any set; a file starts with the set's name in brackets.")
        head = {key: content.get(key, "") for key in ("title", "source")}
        tissues = {key: value for key, value in content.items() if key not in head}
        if not tissues:
            raise InputError(f"{where}: the set '{name}' has no tissue; add [{name}.fat] with a material law.")
        materials = {tissue: _law(f"{where}, {name}.{tissue}", given) for tissue, given in tissues.items()}
        sets[name] = MaterialSet(name, str(head["title"]), str(head["source"]), MappingProxyType(materials))
    if not sets:
        raise InputError(f"{where}: no material set in it.")
    return sets


def _law(where: str, given: object) -> Material:
    if not isinstance(given, dict):
        raise InputError(f"{where}: a tissue is a table with a material law and its numbers; got {given!r}.")
    law = given.get("law")
    made = _constructor(where, law, given.get("convention"))
    taken = inspect.signature(made).parameters
    values: dict[str, float | list[float]] = {}
    for key, value in given.items():
        if key in ("law", "convention"):
            continue
        bare, scale = next(((key.removesuffix(u), f) for u, f in _TO_MPA.items() if key.endswith(u)), (key, None))
        argument = f"{bare}_mpa" if scale else bare
        if f"{key}_mpa" in taken:
            raise InputError(f"{where}: '{key}' needs its unit: {key}_kpa or {key}_mpa.")
        if argument not in taken:
            wanted = ", ".join(name.replace("_mpa", "_kpa (or _mpa)") for name in taken)
            raise InputError(f"{where}: {law} has no '{key}'; it takes {wanted}.")
        if argument in values:
            raise InputError(f"{where}: '{bare}' is given twice.")
        values[argument] = _numbers(where, key, value, scale or 1.0, several=law == "Ogden" and bare != "nu")
    missing = [name.replace("_mpa", "_kpa") for name in taken if name not in values and name != "c30_mpa"]
    if missing:
        raise InputError(f"{where}: {law} needs {', '.join(missing)}.")
    try:
        return made(**values)
    except InputError as refused:
        raise InputError(f"{where}: {refused}") from refused


def _constructor(where: str, law: object, convention: object) -> _Constructor:
    if law == "Ogden" and convention not in _OGDEN:
        raise InputError(
            f"{where}: an Ogden law needs convention = {' or '.join(map(repr, _OGDEN))}, the program that its numbers "
            f"are for: the same numbers differ by a factor of alpha / 2 in stiffness; got {convention!r}."
        )
    if law == "Ogden":
        return _OGDEN[str(convention)]
    if law not in _LAWS:
        raise InputError(f"{where}: law must be one of {', '.join((*_LAWS, 'Ogden'))}; got {law!r}.")
    if convention is not None:
        raise InputError(f"{where}: convention is for Ogden laws only; {law} has one form.")
    return _LAWS[str(law)]


def _numbers(where: str, key: str, value: object, scale: float, *, several: bool) -> float | list[float]:
    given: list[object] = value if isinstance(value, list) and several else [value]
    numbers = [float(v) for v in given if isinstance(v, (int, float)) and not isinstance(v, bool)]
    if not numbers or len(numbers) < len(given):
        wanted = "a number or a list of numbers" if several else "a number"
        raise InputError(f"{where}: {key} must be {wanted}; got {value!r}.")
    scaled = [scale * v for v in numbers]
    return scaled if isinstance(value, list) else scaled[0]
