"""How images were acquired and measured, from headers, records and a study file: as a table and as a sentence."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dvc import Image
from dvc.io.images.scan_parameters import ScanParameters, read_scan_parameters
from dvc.io.result_folder import PROVENANCE, QUALITY
from dvc.report.page import Section, Table, shown
from mrstrain.options.acquisition import AcquisitionOptions
from mrstrain.records.provenance import read_record

if TYPE_CHECKING:  # it draws
    from dvc import Measurement

TITLE = "Acquisition and measurement"
"""Title of the section of a report."""
NOT_GIVEN = "not given"
"""Shown for a value that no file gives."""
ACQUIRED = "Images were acquired"
"""How the sentence of the methods text begins."""
_SCANS, _NOISE = "scans", "noise"  # in provenance.json
_UNLOADED = "unloaded image"
_PARAMETERS = {
    "manufacturer": "Scanner, manufacturer", "scanner": "Scanner, model", "field_strength_t": "Field strength, T",
    "sequence_type": "Sequence, type", "sequence_name": "Sequence, name",
    "repetition_time_ms": "Repetition time (TR), ms", "echo_time_ms": "Echo time (TE), ms",
    "flip_angle_deg": "Flip angle, degrees", "acquisition_matrix": "Matrix of the acquisition",
}  # fmt: skip
_NOTE = (
    'Source "header": DICOM, or the JSON file of dcm2niix beside a NIfTI file. Its texts are shown only if they are '
    "known names of scanners and sequences, so that no patient is named. A study file can give the rest, under "
    "[acquisition]. SNR: 75th percentile of the signal in tissue, divided by the standard deviation of the noise. "
    "Standard uncertainty: standard deviation of the error about its bias. The spatial resolution is not measured on "
    "these images; that on phantoms is in the documentation (Limitations)."
)
_WEIGHTS = {"bending": "1/mm", "volume": "1/mm³", "rigidity": "1/mm³", "volume_gradient": "1/mm"}
_SPLINE_ALONE = "none but the control point spacing"
Record = Mapping[str, Any]
_Row = tuple[str, str, str]


def scans_record(unloaded: tuple[Path, Image], loads: Mapping[str, tuple[Path, Image]]) -> dict[str, object]:
    """Acquisition of each image for provenance.json: matrix, voxel size (mm), and the parameters in its header."""
    return {
        _SCANS: {
            name: {
                "matrix": list(image.grid.shape), "voxel_mm": np.round(image.grid.spacing_mm, 6).tolist(),
                **read_scan_parameters(path).known(),
            }
            for name, (path, image) in {_UNLOADED: unloaded, **loads}.items()
        }
    }  # fmt: skip


def noise_record(measured: "Measurement") -> dict[str, object]:
    """Noise of a pair for provenance.json: SNR of both images, and median standard uncertainty of the max. shear."""
    found = None if measured.source is None else measured.source.registration
    reference, loaded = (None, None) if found is None else found.noise
    snr = {"unloaded": reference, "loaded": loaded}
    known = {name: round(one.snr, 2) for name, one in snr.items() if one is not None and np.isfinite(one.snr)}
    sigma = measured.sigma
    sure = {} if sigma is None else {"median_sigma_max_shear": round(float(np.nanmedian(sigma)), 6)}
    return {_NOISE: {"snr": known, **sure}}


def acquisition_section(folders: Mapping[str, Path], given: AcquisitionOptions | None = None) -> Section | None:
    """The section of a report on the loads measured in these folders; None if nothing is recorded or given."""
    known = _Known.read(folders, given)
    if known.empty:
        return None
    columns = ("parameter", "value", "source")
    return Section(TITLE, None, (Table("Parameters", columns, tuple(known.rows()), _NOTE),), folded=True)


def acquisition_sentence(folders: Mapping[str, Path], given: AcquisitionOptions | None = None) -> str:
    """A paragraph of a methods section on the acquisition; empty if no header and no study file describes it."""
    known = _Known.read(folders, given)
    told = {name: known.in_a_sentence(name) for name in _PARAMETERS}
    if all(value == NOT_GIVEN for value in told.values()):
        return ""

    def part(words: str, *names: str) -> str:
        values = [told[name] for name in names]
        return words.format(*values) if NOT_GIVEN not in values else ""

    scanner = " ".join(told[name] for name in ("manufacturer", "scanner") if told[name] != NOT_GIVEN)
    parts = [
        part(" at {} T", "field_strength_t"), f" ({scanner})" if scanner else "",
        part(" with the sequence {}", "sequence_type"), part(" ({})", "sequence_name"),
        part(", TR {} ms", "repetition_time_ms"), part(", TE {} ms", "echo_time_ms"),
        part(", flip angle {} degrees", "flip_angle_deg"), part(", acquisition matrix {}", "acquisition_matrix"),
    ]  # fmt: skip
    lacking = [words for name, words in _PARAMETERS.items() if told[name] == NOT_GIVEN]
    voxels = known.images(lambda scan: _sizes(scan.get("voxel_mm")))
    size = "" if voxels == NOT_GIVEN else f", voxels of {voxels} mm"
    more = f" Not given: {'; '.join(lacking)}." if lacking else ""
    return f"{ACQUIRED}{''.join(parts)}{size}.{more}"


class _Known:
    """Acquisition parameters by image, from the records of measured loads and from the study file."""

    def __init__(self, records: Mapping[str, Record], qualities: Mapping[str, Record], given: AcquisitionOptions):
        self.qualities, self.given = qualities, given
        self.scans: dict[str, Record] = {}
        self.noise = {load: _mapping(record.get(_NOISE)) for load, record in records.items()}
        self.engines = {load: _mapping(record.get("parameters")) for load, record in records.items()}
        for load, parameters in self.engines.items():
            scans = _mapping(parameters.get(_SCANS))
            self.scans |= {name: _mapping(scan) for name, scan in scans.items() if name in (_UNLOADED, load)}

    @classmethod
    def read(cls, folders: Mapping[str, Path], given: AcquisitionOptions | None) -> "_Known":
        records = {load: read_record(folder / PROVENANCE) for load, folder in folders.items()}
        qualities = {load: read_record(folder / QUALITY) for load, folder in folders.items()}
        return cls(records, qualities, given or AcquisitionOptions())

    @property
    def empty(self) -> bool:
        return not self.scans and self.given == AcquisitionOptions()

    def images(self, read: Callable[[Record], str | float | None]) -> str:
        """A value of every image; images that have others than the unloaded one are named."""
        return _together({name: read(scan) for name, scan in self.scans.items()})

    def parameter(self, name: str) -> tuple[str, str]:
        """A parameter of the acquisition and its source; both values if header and study file differ."""
        of_header, by_person = self.images(lambda scan: scan.get(name)), _text(getattr(self.given, name))
        if of_header == NOT_GIVEN:
            return by_person, "" if by_person == NOT_GIVEN else "study file"
        if by_person not in (NOT_GIVEN, *self._told_by_headers(name)):
            return f"{of_header} (study file: {by_person})", "header"
        return of_header, "header"

    def in_a_sentence(self, name: str) -> str:
        """A parameter from the headers that have it, or else from the study file."""
        values = self._told_by_headers(name)
        if len(values) < 2:
            return next(iter(values), _text(getattr(self.given, name)))
        return " and ".join(f"{value} ({', '.join(of)})" for value, of in values.items())

    def _told_by_headers(self, name: str) -> dict[str, list[str]]:
        """Values from headers, each with its images."""
        values: dict[str, list[str]] = {}
        for image, scan in self.scans.items():
            if (value := _text(scan.get(name))) != NOT_GIVEN:
                values.setdefault(value, []).append(image)
        return values

    def rows(self) -> Iterable[_Row]:
        for name, words in _PARAMETERS.items():
            yield (words, *self.parameter(name))
        yield self._measured("Matrix of the image, voxels", self.images(lambda scan: _sizes(scan.get("matrix"))))
        yield self._measured("Voxel size of the image, mm", self.images(lambda scan: _sizes(scan.get("voxel_mm"))))
        snr = {_UNLOADED: self._first()} | {load: self._snr(load, "loaded") for load in self.noise}
        yield self._measured("Signal-to-noise ratio (SNR)", _together(snr), self.given.snr)
        yield self._floor()
        sigma = {load: of.get("median_sigma_max_shear") for load, of in self.noise.items()}
        yield self._measured(
            "Standard uncertainty of max. shear, median over voxels", _together(sigma), source="error model"
        )
        spacing = {load: _sizes(self._alignment(load).get("control_spacing_mm")) for load in self.qualities}
        yield self._measured("Control point spacing of the displacement, mm", _together(spacing), source="registration")
        weights = {load: _weights(of) for load, of in self.qualities.items()}
        yield self._measured("Regularisation weights", _together(weights), source="registration")
        yield self._measured("Spatial resolution of the strain", NOT_GIVEN, self.given.spatial_resolution)

    def _alignment(self, load: str) -> Record:
        return _mapping(self.qualities[load].get("alignment"))

    def _snr(self, load: str, image: str) -> float | None:
        value = _mapping(self.noise[load].get("snr")).get(image)
        return float(f"{value:.2g}") if isinstance(value, int | float) else None

    def _first(self) -> float | None:
        return next((snr for load in self.noise if (snr := self._snr(load, "unloaded")) is not None), None)

    def _floor(self) -> _Row:
        """The noise floor of the repeat scan."""
        floors = (_mapping(of.get("noise_floor")) for of in self.qualities.values())
        floor = next((one for one in floors if one), {})
        names = ("max_shear_p50", "max_shear_p95", "maer", "sder")
        told = "median {}, 95th percentile {}; MAER {}, SDER {}".format(*(_text(floor.get(name)) for name in names))
        known = told if floor else NOT_GIVEN
        return self._measured("Noise floor of max. shear", known, self.given.noise_floor, "repeat scan")

    @staticmethod
    def _measured(words: str, value: str, given: str | float | None = None, source: str = "images") -> _Row:
        """A row with the value measured here, and that of the study file if there is one."""
        own = _text(given)
        if value == NOT_GIVEN:
            return words, own, "" if own == NOT_GIVEN else "study file"
        return words, value if own == NOT_GIVEN else f"{value} (study file: {own})", source


def _together(values: Mapping[str, str | float | None]) -> str:
    """Values by image as one text: alone where all are alike, else each with the images that have it."""
    images: dict[str, list[str]] = {}
    for image, value in values.items():
        images.setdefault(_text(value), []).append(image)
    if len(images) <= 1:
        return next(iter(images), NOT_GIVEN)
    return "; ".join(f"{value} ({', '.join(of)})" for value, of in images.items())


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}" if np.isfinite(value) else NOT_GIVEN
    return NOT_GIVEN if value is None or value == "" else shown(value if isinstance(value, str | int) else str(value))


def _sizes(value: object) -> str | None:
    if not isinstance(value, Sequence) or isinstance(value, str):
        return None
    return " x ".join(f"{one:.3g}" if isinstance(one, float) else str(one) for one in value)


def _weights(quality: Record) -> str | None:
    """The weights that were used, each with what it penalises; an engine without weights has its spline alone."""
    regularisation = _mapping(quality.get("regularisation"))
    weights = _mapping(regularisation.get("weights"))
    if not weights:
        return _SPLINE_ALONE if "control_spacing_mm" in _mapping(quality.get("alignment")) else None
    told = {name: name.replace("_", " ") for name in weights}
    if of := regularisation.get("rigidity_of"):
        told["rigidity"] = f"strain of the {of}"
    return ", ".join(
        f"{told[name]} {_digits(value)} {_WEIGHTS.get(name, '')}".rstrip()
        for name, value in weights.items()
        if isinstance(value, int | float) and value
    )


def _digits(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.3g}" if value < 100.0 else f"{value:.0f}"


def _mapping(value: object) -> Record:
    return value if isinstance(value, Mapping) else {}


assert set(_PARAMETERS) == set(ScanParameters.__dataclass_fields__)
