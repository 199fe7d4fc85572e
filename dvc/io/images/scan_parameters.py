"""How an image was acquired, from its header: DICOM, or the JSON file that dcm2niix writes beside a NIfTI file.

Any element of a header may name a patient. Therefore numbers are taken only within the range of real scanners, codes
only if the standard defines them, and text only if every word belongs to a known scanner or sequence.

References
----------
.. [1] DICOM PS3.3, MR Image Module (C.8.3.1) and MR functional groups (C.8.13.5):
   https://dicom.nema.org/medical/dicom/current/output/html/part03.html
.. [2] Gorgolewski et al., The brain imaging data structure, Sci Data 3:160044, 2016, doi:10.1038/sdata.2016.44.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dvc.errors import ImageFileError
from dvc.io import StrPath
from dvc.io.images.dicom import is_dicom
from dvc.io.images.dicom_frames import damage_named
from dvc.own_files import read_json

_MAKERS = {
    "Siemens": "siemens", "GE": "ge", "Philips": "philips", "Canon": "canon", "Toshiba": "toshiba",
    "Hitachi": "hitachi", "Fujifilm": "fujifilm", "Bruker": "bruker", "United Imaging": "united imaging|uih",
    "Esaote": "esaote", "Hyperfine": "hyperfine", "Agilent": "agilent", "Varian": "varian", "Neusoft": "neusoft",
    "MR Solutions": "mr solutions", "Paramed": "paramed", "Aspect Imaging": "aspect",
}  # fmt: skip
_PRODUCTS = """
magnetom avanto aera altea amira biograph cima espree essenza flow free lumina max mmr prisma skyra sola sonata spectra
star symphony terra trio triotim verio vida fit
signa architect artist brivo champion creator discovery excite explorer genesis hd hdx hdxt hero optima pioneer premier
prime voyager
achieva ambition dstream elition evolution gyroscan ingenia ingenuity intera marlin panorama prodiva
vantage titan galan orian elan centurian fortian airis aperto echelon oasis synergy velocity biospec pharmascan umr
swoop scan
"""
_SCANNERS = frozenset(_PRODUCTS.split())
"""Words of the names of products: of Siemens, GE, Philips, and others."""
_OF_SCANNER = re.compile(r"(?:mr)?\d{1,4}[a-z]?|\d(?:\.\d{1,2})?t?|[xstg]|cx|xr|mr|pet|tim")
"""A word that is no name: a number, a field strength, the version of a product."""
_SEQUENCE = re.compile(
    r"\*?(?:t?fl|t?fi|qfl|spc|spcir|t?se|tse|tir|tirse|hst|ep|epfid|epse|gre|fe|fse|frfse|fgre|efgre|fspgr|efspgr|spgr|"
    r"bravo|cube|cosmic|fiesta|fastcard|vibe|dess|de|ciss|ci|psif|me|memp|mde|ffe|tfe|tffe|t1ffe|t1tfe|bffe|lava|"
    r"3dfspgr|3dgrass|ideal|dixon|mprage)(?:[23]d)?\d{0,3}(?:r|rb|b|t|p|ns|ss|ir|fs)?(?:_\d{0,3}(?:r|rb|b|t|p|ns|ss|ir|fs)?)?",
    re.IGNORECASE,
)
_ECHOES = {
    "SE": "spin echo", "GR": "gradient echo", "IR": "inversion recovery", "EP": "echo planar", "RM": "research mode",
    "SPIN": "spin echo", "GRADIENT": "gradient echo", "BOTH": "spin and gradient echo",
}  # fmt: skip
_VARIANTS = {
    "SK": "segmented k-space", "MTC": "magnetisation transfer", "SS": "steady state", "SP": "spoiled",
    "TRSS": "time-reversed steady state", "MP": "prepared magnetisation", "OSP": "phase oversampling",
}  # fmt: skip
_TAGS = (
    "Rows", "Manufacturer", "ManufacturerModelName", "MagneticFieldStrength", "ScanningSequence", "SequenceVariant",
    "EchoPulseSequence", "MRAcquisitionType", "SequenceName", "PulseSequenceName", "RepetitionTime", "EchoTime",
    "FlipAngle", "AcquisitionMatrix", "SharedFunctionalGroupsSequence", "PerFrameFunctionalGroupsSequence",
)  # fmt: skip
_GROUPS = {  # of enhanced files: the sequence that an element lies in, and the name of the element there
    "RepetitionTime": ("MRTimingAndRelatedParametersSequence", "RepetitionTime"),
    "FlipAngle": ("MRTimingAndRelatedParametersSequence", "FlipAngle"),
    "EchoTime": ("MREchoSequence", "EffectiveEchoTime"),
    "frequency": ("MRFOVGeometrySequence", "MRAcquisitionFrequencyEncodingSteps"),
    "phase": ("MRFOVGeometrySequence", "MRAcquisitionPhaseEncodingStepsInPlane"),
}
_MS = 1000.0


@dataclass(frozen=True, slots=True)
class ScanParameters:
    """Parameters of an MR acquisition from a header; None if the header does not give them.

    Attributes
    ----------
    manufacturer, scanner : str or None
        Maker and model of the scanner.
    field_strength_t : float or None
        Strength of the static field, T.
    sequence_type, sequence_name : str or None
        Kind of sequence in words, and its name on the scanner.
    repetition_time_ms, echo_time_ms : float or None
        TR and TE, ms.
    flip_angle_deg : float or None
        Flip angle, degrees.
    acquisition_matrix : str or None
        Samples along the frequency- and the phase-encoding direction. The image may be interpolated to more voxels.
    """

    manufacturer: str | None = None
    scanner: str | None = None
    field_strength_t: float | None = None
    sequence_type: str | None = None
    sequence_name: str | None = None
    repetition_time_ms: float | None = None
    echo_time_ms: float | None = None
    flip_angle_deg: float | None = None
    acquisition_matrix: str | None = None

    def known(self) -> dict[str, str | float]:
        """What is known, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def read_scan_parameters(path: StrPath) -> ScanParameters:
    """Read how an image was acquired, from its header or from the JSON file of dcm2niix beside it.

    A file that cannot be read gives no parameters; `dvc.read_image` reports what is wrong with it.
    """
    place, told = Path(path), dict[str, Any]()
    with suppress(OSError, ValueError, ImageFileError):
        told = _of_sidecar(place) if _sidecar(place) else _of_dicom(place)
    return ScanParameters(
        manufacturer=_maker(told.get("Manufacturer")),
        scanner=_scanner(told.get("ManufacturerModelName")),
        field_strength_t=_number(told.get("MagneticFieldStrength"), 0.001, 30.0),
        sequence_type=_kind(told),
        sequence_name=_sequence(told.get("SequenceName") or told.get("PulseSequenceName")),
        repetition_time_ms=_number(told.get("RepetitionTime"), 0.1, 1e5),
        echo_time_ms=_number(told.get("EchoTime"), 0.001, 1e4),
        flip_angle_deg=_number(told.get("FlipAngle"), 0.1, 360.0),
        acquisition_matrix=_matrix(told.get("frequency"), told.get("phase")),
    )


def _sidecar(place: Path) -> Path | None:
    """The JSON file beside a NIfTI file."""
    for ending in (".nii.gz", ".nii"):
        if place.name.lower().endswith(ending):
            return place.with_name(place.name[: -len(ending)] + ".json")
    return None


def _of_sidecar(place: Path) -> dict[str, Any]:
    """Elements that dcm2niix wrote, under their DICOM names, times in ms."""
    sidecar = _sidecar(place)
    told = {} if sidecar is None else read_json(sidecar)
    times = {name: _number(told.get(name), 1e-6, 100.0) for name in ("RepetitionTime", "EchoTime")}
    return told | {
        "ManufacturerModelName": told.get("ManufacturersModelName"),
        **{name: None if seconds is None else round(_MS * seconds, 6) for name, seconds in times.items()},
        "frequency": told.get("BaseResolution") or told.get("FrequencyEncodingSteps"),
        "phase": told.get("AcquisitionMatrixPE") or told.get("PhaseEncodingSteps"),
    }


def _of_dicom(place: Path) -> dict[str, Any]:
    """Elements of the first image of a file or folder."""
    import pydicom

    files = sorted(p for p in place.iterdir() if p.is_file()) if place.is_dir() else [place]
    for path in (one for one in files if not one.name.startswith(".") and is_dicom(one)):
        with damage_named(path):
            header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
            if "Rows" not in header:
                continue
            told = {name: header.get(name) for name in _TAGS[1:-2]}
            steps = [int(n) for n in told.pop("AcquisitionMatrix") or () if int(n)]
            told |= dict(zip(("frequency", "phase"), steps, strict=False)) if len(steps) == 2 else {}
            return told | {name: value for name, value in _of_groups(header)}
    return {}


def _of_groups(header: Any) -> Iterator[tuple[str, Any]]:
    """Elements in the functional groups of an enhanced file, the first frame's before the shared ones."""
    groups = [(header.get(f"{of}FunctionalGroupsSequence") or [None])[0] for of in ("PerFrame", "Shared")]
    for name, (sequence, element) in _GROUPS.items():
        items = [item for group in groups if group is not None for item in group.get(sequence) or ()]
        if found := [item.get(element) for item in items if item.get(element) is not None]:
            yield name, found[0]


def _number(value: object, low: float, high: float) -> float | None:
    """A number within limits; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        number = float(value)
    except ValueError:
        return None
    return number if low <= number <= high else None


def _words(value: object) -> str:
    return " ".join(str(value or "").split())


def _maker(value: object) -> str | None:
    text = _words(value)
    return next((name for name, words in _MAKERS.items() if re.search(rf"\b(?:{words})\b", text, re.IGNORECASE)), None)


def _scanner(value: object) -> str | None:
    """The model of a scanner, if every word of it is one of a product."""
    text = _words(value)
    words = [word for word in re.split(r"[\s_/-]+", text.lower()) if word]
    known = any(word.partition(".")[0] in _SCANNERS for word in words)
    return text if known and all(_is_of_scanner(word) for word in words) else None


def _is_of_scanner(word: str) -> bool:
    return _OF_SCANNER.fullmatch(word) is not None or all(part in _SCANNERS for part in word.split("."))


def _sequence(value: object) -> str | None:
    text = _words(value)
    return text if _SEQUENCE.fullmatch(text) else None


def _codes(value: object) -> list[str]:
    """Codes of an element of one or several values; dcm2niix joins them by a backslash or an underscore."""
    if value is None or isinstance(value, Mapping):
        return []
    several = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    return [code for one in several for code in re.split(r"[\\_]", str(one)) if code]


def _kind(told: Mapping[str, Any]) -> str | None:
    """Kind of a sequence in words: 2D or 3D, what is read out, and how it is modified."""
    echoes = [_ECHOES[c] for c in _codes(told.get("ScanningSequence") or told.get("EchoPulseSequence")) if c in _ECHOES]
    if not echoes:
        return None
    dimensions = [code for code in _codes(told.get("MRAcquisitionType")) if code in ("2D", "3D")]
    variants = [_VARIANTS[code] for code in _codes(told.get("SequenceVariant")) if code in _VARIANTS]
    return ", ".join([" ".join([*dimensions[:1], " with ".join(dict.fromkeys(echoes))]), *dict.fromkeys(variants)])


def _matrix(frequency: object, phase: object) -> str | None:
    steps = [_number(value, 1.0, 1e5) for value in (frequency, phase)]
    return " x ".join(f"{step:.0f}" for step in steps if step is not None) if None not in steps else None
