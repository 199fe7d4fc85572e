"""Material sets: seven published ones, and your own in the same file format."""

import difflib
import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

from dvc.errors import InputError, few
from dvc.file_names import refuse_as_file_name, refuse_path
from dvc.own_files import parse_toml
from dvc.tables import refuse_damaged_toml
from fe.hyperelastic import OGDEN
from fe.materials import MODES, Hencky, Material, Materials, NeoHooke, Ogden, Yeoh

WHOLE = "all"
"""Name of the tissue in a set that has one constitutive model for all tissues."""

_FAR, _ODD = 10.0, 1000.0  # times the range of the published material sets: for their tissues, and for any other
_UNITS = {1e-3: " Are its parameters in kPa, entered as MPa?", 1e3: " Are they in MPa, entered as kPa?"}
_ALIKE = 0.8, 1.25  # times a published model of all tissues, which may be that of a tissue
_USED = 0.7, 1.4  # stretches of tissue under a plate
_INSTEAD = {"tendon": ("muscle", "fat"), "aponeurosis": ("muscle", "fat"), "muscle": ("fat",)}


def _isihara(c10_mpa: float, c20_mpa: float, nu: float = 0.4999) -> Yeoh:
    return Yeoh.of(c10_mpa, c20_mpa, nu=nu)


_Constructor = Callable[..., Material]  # its parameters are the keys of the file; stresses end in _mpa
_LAWS: Mapping[str, _Constructor] = {
    "neo-Hooke": NeoHooke.of, "Isihara": _isihara, "Yeoh": Yeoh.of, "Hencky": Hencky.of, "linear elastic": Hencky.of
}  # as `fit --law` calls them, and as publications call Hencky's  # fmt: skip
_OGDEN: Mapping[str, _Constructor] = {
    "ansys": Ogden.from_ansys, "abaqus": Ogden.from_abaqus, "febio": Ogden.from_febio
}  # by convention  # fmt: skip
_TO_MPA = {"_mpa": 1.0, "_kpa": 1e-3}


@dataclass(frozen=True, slots=True, eq=False)
class MaterialSet:
    """A material set: a constitutive model with its parameters for each tissue.

    Attributes
    ----------
    name, title, source : str
        Short name, authors, and where the parameters were published.
    materials : mapping of tissue to Material
        The key "all" stands for one material for every tissue.
    """

    name: str
    title: str
    source: str
    materials: Materials

    def for_regions(self, regions: Iterable[str]) -> tuple[dict[str, Material], tuple[str, ...]]:
        """The material of each region of a mesh, and sentences on what a person should know of that choice.

        That is each region that gets the material of another tissue; each tissue that is over ten times as stiff, or as
        soft, as in any published set that names it, or outside their range and within it in another unit; and each
        material that is not stable at stretches of 0.7 to 1.4, where its stress falls.

        Tendon and aponeurosis without a material get that of muscle, or else of fat; muscle gets that of fat. No other
        substitution is made.

        Raises
        ------
        InputError
            If a region has no material in the set and no substitute.

        Examples
        --------
        >>> materials, notes = material_set("friedman").for_regions(["fat", "skin", "muscle"])
        >>> materials["muscle"] is materials["fat"], notes
        (True, ('friedman has no material for muscle; that of fat is used.',))
        """
        if WHOLE in self.materials:
            by_region = dict.fromkeys(regions, self.materials[WHOLE])
            return by_region, tuple(doubts(self.name, self.materials))
        of = {tissue.casefold(): law for tissue, law in self.materials.items()}
        by_region = {region: of[self._tissue_for(region).casefold()] for region in regions}
        return by_region, (*self.substitutes(by_region), *doubts(self.name, by_region))

    def substitutes(self, regions: Iterable[str]) -> tuple[str, ...]:
        """A sentence for each region that gets the material of another tissue; errors as `for_regions`."""
        if WHOLE in self.materials:
            return ()
        used = {region: self._tissue_for(region) for region in regions}
        return tuple(
            f"{self.name} has no material for {region}; that of {name} is used."
            for region, name in used.items()
            if name != region
        )

    def _tissue_for(self, region: str) -> str:
        """The tissue whose material a region gets."""
        known = {tissue.casefold() for tissue in self.materials}
        tried = (region, *_INSTEAD.get(region.casefold(), ()))
        name = next((t for t in tried if t.casefold() in known), None)
        if name is None:
            instead = f" (nor for {' or '.join(tried[1:])}, as a substitute)" if tried[1:] else ""
            raise InputError(
                f"The material set {self.name} has no material for the region '{region}'{instead}; it has "
                f"{few(self.materials, most=3)}. Write your own set (.toml) with it, rename the region, or "
                "mesh it as a bone (bones, --bone)."
            )
        return name


def doubts(name: str, materials: Materials) -> list[str]:
    """Sentences on materials whose stiffness is odd, and on those whose stress falls at strains of use."""
    return [*_odd_stiffness(name, materials), *_falling(name, materials)]


def _falling(name: str, materials: Materials) -> list[str]:
    """A sentence for each tissue whose material is not stable at stretches of use, with the narrowest of its ranges."""
    found = []
    for tissue, law in materials.items():
        ranges = {mode: law.stable_range(mode) for mode in MODES}
        mode = min(ranges, key=lambda mode: ranges[mode][1] / ranges[mode][0])
        low, high = ranges[mode]
        if low > _USED[0] or high < _USED[1]:
            found.append(
                f"{name}: the material of {tissue} is stable (rising stress) only at {mode} stretches from {low:.2f} "
                f"to {high:.2f}; tissue under a plate reaches stretches from {_USED[0]:g} to {_USED[1]:g}. Check the "
                "signs of the parameters."
            )
    return found


def _odd_stiffness(name: str, materials: Materials) -> list[str]:
    """A sentence for each tissue whose shear modulus no published set comes near, with the likely unit."""
    found = []
    lumped = {one.materials[WHOLE].shear_modulus_mpa for one in _published().values() if WHOLE in one.materials}
    alike = len({id(law) for law in materials.values()}) == 1 and {"fat", "skin"} <= {t.casefold() for t in materials}
    for tissue, law in materials.items():
        own, (low, high, is_named) = law.shear_modulus_mpa, _published_mpa(WHOLE if alike else tissue.casefold())
        times = _FAR if is_named else _ODD
        # tissues of no set may be as stiff as bone
        is_near = low / times <= own and (own <= high * times or not is_named)
        inside = [0.999 * low <= own * to <= 1.001 * high for to in (1.0, *_UNITS)]
        is_in_other_unit = is_named and not inside[0] and any(inside)
        if (is_near and not is_in_other_unit) or any(_ALIKE[0] * one <= own <= _ALIKE[1] * one for one in lumped):
            continue
        stiff = own > high
        far = f"over {times:g} times as {'stiff' if stiff else 'soft'} as"
        if is_near:
            far = "stiffer than" if stiff else "softer than"
        unit = next((asks for to, asks in _UNITS.items() if low / _FAR <= own * to <= high * _FAR), "")
        found.append(
            f"{name}: {tissue} has a shear modulus of {1e3 * own:.3g} kPa, which is {far} in any published set "
            f"({1e3 * low:.3g} to {1e3 * high:.3g} kPa).{unit}"
        )
    return found


def _published_mpa(tissue: str) -> tuple[float, float, bool]:
    """Least and largest shear modulus of a tissue in the published material sets, and whether one names it.

    That of all tissues as one may be that of any; a tissue that no set names may be as any.
    """
    sets = [{t: law.shear_modulus_mpa for t, law in one.materials.items()} for one in _published().values()]
    tried = (tissue, *_INSTEAD.get(tissue, ()))
    known = [next(of[t] for t in tried if t in of) for of in sets if tissue != WHOLE and any(t in of for t in tried)]
    known = known or [modulus for of in sets for modulus in of.values()]
    return min(known), max(known), tissue == WHOLE or any(tissue in of for of in sets)


def published_names() -> list[str]:
    """Names of the material sets that are included in mrstrain."""
    return list(_published())


def material_set(name: str | Path) -> MaterialSet:
    """A published material set by its name, or the only set in your own file by its path (.toml).

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
            raise InputError(
                f"{name} contains {len(sets)} material sets ({few(sets)}), and one is needed. Write one file per "
                "set, or read all with fe.read_material_sets."
            )
        return next(iter(sets.values()))
    known = _published()
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else "."
        raise InputError(f"Unknown material set '{name}'{hint} Available are {', '.join(known)}, or your own .toml.")
    return known[str(name)]


def as_material_set(given: MaterialSet | Materials | Path | str) -> MaterialSet:
    """A material set from a set, a name, a file, or a mapping of region to material."""
    if isinstance(given, (str, Path)):
        return material_set(given)
    return given if isinstance(given, MaterialSet) else MaterialSet("materials", "", "", dict(given))


def read_material_sets(path: str | Path) -> dict[str, MaterialSet]:
    """All material sets of a file, by name; the format is that of ``fe/published.toml``.

    Raises
    ------
    InputError
        If the file cannot be read, a key is unknown or missing, or a number is out of range. The message names file,
        set and tissue.
    """
    try:
        refuse_path(path)
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as failure:
        raise InputError(f"{path}: the material sets cannot be read ({failure}).") from failure
    return _parsed(str(path), text)


def as_toml(name: str, title: str, materials: Materials) -> str:
    """A material set as TOML text for `read_material_sets`; Ogden parameters in the convention of Abaqus.

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
    """The keys and values of a constitutive model in a file."""
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
        tables = parse_toml(text)
    except ValueError as failure:
        raise InputError(f"{where}: not a TOML file: {failure}.") from failure
    refuse_damaged_toml(where, text, tables)
    sets = {}
    for name, content in tables.items():
        if not isinstance(content, dict):
            raise InputError(
                f"{where}: '{name}' does not belong to a set; a set begins with its name in brackets, such as [mine]."
            )
        head = {key: content.get(key, "") for key in ("title", "source")}
        tissues = {key: value for key, value in content.items() if key not in head}
        if not tissues:
            raise InputError(f"{where}: the set '{name}' has no tissue; add a table such as [{name}.fat] with a 'law'.")
        materials = {tissue: _law(f"{where}, {name}.{tissue}", given) for tissue, given in tissues.items()}
        refuse_as_file_name("material set", name, where)
        sets[name] = MaterialSet(name, str(head["title"]), str(head["source"]), MappingProxyType(materials))
    if not sets:
        raise InputError(f"{where}: the file contains no material set.")
    return sets


def _law(where: str, given: object) -> Material:
    if not isinstance(given, dict):
        raise InputError(f"{where}: a tissue must be a table with 'law' and its parameters; got {given!r}.")
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
            raise InputError(f"{where}: the model {law} has no parameter '{key}'; its parameters are {wanted}.")
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
            f"{where}: an Ogden model needs convention = {' or '.join(map(repr, _OGDEN))}; got {convention!r}. "
            "Programs define mu differently: the same mu gives stiffnesses that differ by a factor such as alpha / 2."
        )
    if law == "Ogden":
        return _OGDEN[str(convention)]
    if law not in _LAWS:
        raise InputError(f"{where}: law must be one of {', '.join((*_LAWS, 'Ogden'))}; got {law!r}.")
    if convention is not None:
        raise InputError(f"{where}: 'convention' is only for Ogden models; remove it for {law}.")
    return _LAWS[str(law)]


def _numbers(where: str, key: str, value: object, scale: float, *, several: bool) -> float | list[float]:
    given: list[object] = value if isinstance(value, list) and several else [value]
    numbers = [float(v) for v in given if isinstance(v, (int, float)) and not isinstance(v, bool)]
    if not numbers or len(numbers) < len(given):
        wanted = "a number or a list of numbers" if several else "a number"
        raise InputError(f"{where}: {key} must be {wanted}; got {value!r}.")
    scaled = [scale * v for v in numbers]
    return scaled if isinstance(value, list) else scaled[0]
