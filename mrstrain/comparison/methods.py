"""Text for a methods section, generated from the records of the compared results."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dvc.io.images.read import format_of
from dvc.io.result_folder import PROVENANCE, QUALITY
from dvc.registration.engines import methods_of
from dvc.report.alike import listed
from dvc.report.page import NIIVUE
from fe import LoadStep
from mrstrain.measurement.acquisition import acquisition_sentence
from mrstrain.records.provenance import read_record, versions
from validate import Comparison, Criteria
from validate.curves import DRAWS
from validate.location import LOCATION_DRAWS

# Checked against the publishers' records or the projects' own pages; a paper whose DOI was not found has none here.
_PAPERS = {
    "Klein 2010": "Klein S, Staring M, Murphy K, Viergever MA, Pluim JPW. elastix: a toolbox for intensity-based "
    "medical image registration. IEEE Trans Med Imaging 29(1):196-205, 2010. doi:10.1109/TMI.2009.2035616",
    "Shamonin 2014": "Shamonin DP, Bron EE, Lelieveldt BPF, Smits M, Klein S, Staring M. Fast parallel image "
    "registration on CPU and GPU for diagnostic classification of Alzheimer's disease. Front Neuroinform 7:50, 2014. "
    "doi:10.3389/fninf.2013.00050",
    "Baker 2004": "Baker S, Matthews I. Lucas-Kanade 20 years on: a unifying framework. Int J Comput Vis "
    "56(3):221-255, 2004. doi:10.1023/B:VISI.0000011205.11775.fd",
    "Lowekamp 2013": "Lowekamp BC, Chen DT, Ibáñez L, Blezek D. The design of SimpleITK. Front Neuroinform 7:45, 2013. "
    "doi:10.3389/fninf.2013.00045",
    "Chambolle 2005": "Chambolle A. Total variation minimization and a class of binary MRF models. Energy Minimization "
    "Methods in Computer Vision and Pattern Recognition, LNCS 3757:136-152, 2005. doi:10.1007/11585978_10",
    "Tustison 2010": "Tustison NJ, Avants BB, Cook PA, Zheng Y, Egan A, Yushkevich PA, Gee JC. N4ITK: improved N3 bias "
    "correction. IEEE Trans Med Imaging 29(6):1310-1320, 2010. doi:10.1109/TMI.2010.2046908",
    "Hu 2020": "Hu Y, Schneider T, Wang B, Zorin D, Panozzo D. Fast tetrahedral meshing in the wild. ACM Trans Graph "
    "39(4):117, 2020. doi:10.1145/3386569.3392385",
    "Trebbi 2023": "Trebbi A, Fougeron N, Payan Y. Definition and evaluation of a finite element model of the human "
    "heel for diabetic foot ulcer prevention under shearing loads. Med Eng Phys, 2023.",
    "Roache 1994": "Roache PJ. Perspective: a method for uniform reporting of grid refinement studies. J Fluids Eng "
    "116(3):405-413, 1994. doi:10.1115/1.2910291",
    "Dice 1945": "Dice LR. Measures of the amount of ecologic association between species. Ecology 26(3):297-302, "
    "1945. doi:10.2307/1932409",
    "Lin 1989": "Lin LI-K. A concordance correlation coefficient to evaluate reproducibility. Biometrics "
    "45(1):255-268, 1989. doi:10.2307/2532051",
    "Bland 1986": "Bland JM, Altman DG. Statistical methods for assessing agreement between two methods of clinical "
    "measurement. Lancet 327(8476):307-310, 1986. doi:10.1016/S0140-6736(86)90837-8",
    "Dvurecenska 2018": "Dvurecenska K, Graham S, Patelli E, Patterson EA. A probabilistic metric for the validation "
    "of computational models. R Soc Open Sci 5:180687, 2018. doi:10.1098/rsos.180687",
    "Voyles 2015": "Voyles IT, Roy CJ. Evaluation of model validation techniques in the presence of aleatory and "
    "epistemic input uncertainties. 17th AIAA Non-Deterministic Approaches Conference, 2015.",
}
_IMAGES = ("load0", "loads", "repeat", "bone", "tissue", "labels")  # roles of image files in a record
_GIVEN = "the displacement was used as given; there is no record of its registration."
_PUBLISHED = {"trebbi", "akrami", "erdemir", "friedman", "luboz", "spears", "zwam"}  # tables 2 and 3 of Trebbi 2023

Record = Mapping[str, Any]


def methods(
    measured: Mapping[str, Path], models: Mapping[str, Path], comparison: Comparison, criteria: Criteria
) -> tuple[str, ...]:
    """Paragraphs for a methods section, with the references last.

    ``measured`` gives the folder of the measurement for each load, with ``provenance.json`` if `register` or `strain`
    wrote it; ``models`` gives one result file of each model, next to ``simulation.json`` if mrstrain computed it.
    """
    compared = _compared(len(comparison.loads[0].fields.points_mm), criteria)
    uncertainty = [_uncertainty(measured)] if any(one.bands for one in comparison.loads) else []
    uncertainty += [of] if (of := _of_inputs(comparison)) else []
    viewer = f"Volumes in the report are shown with niivue {NIIVUE} (https://github.com/niivue/niivue)."
    acquired = _acquired(measured)
    return _with_references(
        [*acquired, _measured(measured), *_simulated(models, measured), compared, *uncertainty, viewer]
    )


def methods_of_registrations(measured: Mapping[str, Path]) -> tuple[str, ...]:
    """Paragraphs on the measurement alone, with the references last; ``measured`` as in `methods`."""
    known = _sources(_errors(measured))
    error = [f"Error of the maximum shear strain: {known}"] if known else []
    return _with_references([*_acquired(measured), _measured(measured), *error])


def _acquired(measured: Mapping[str, Path]) -> list[str]:
    """How the images were acquired, if their headers describe it."""
    return [told] if (told := acquisition_sentence(measured)) else []


def _with_references(parts: Sequence[str]) -> tuple[str, ...]:
    used = [paper for name, paper in _PAPERS.items() if any(name in part for part in parts)]
    return (*parts, *(("References", *used) if used else ()))


def _measured(measured: Mapping[str, Path]) -> str:
    """How the displacement was measured; loads that were registered in the same way share a sentence."""
    groups: dict[str, list[str]] = {}
    for load, folder in measured.items():
        record = read_record(folder / PROVENANCE)
        groups.setdefault(_registration(record) + _files(record), []).append(load)
    sentences = " ".join(f"{listed(loads)}: {sentence}" for sentence, loads in groups.items())
    return (
        sentences + " Displacement is given in the reference configuration (that of the unloaded image). Strain is the "
        "Green-Lagrange strain E = (F^T F - I)/2, and the maximum shear strain is half the difference between its "
        "largest and smallest principal values."
    )


def _registration(record: Record) -> str:
    parameters, versions = record.get("parameters", {}), record.get("versions", {})
    how = methods_of(parameters, versions)
    if record.get("command") != "register" or not how:
        return _GIVEN
    aligned_on = {"bone": "the bone", "image": "the whole image"}.get(str(parameters.get("align")))
    before = f" aligned with the unloaded one rigidly on {aligned_on}, and then" if aligned_on else ""
    if parameters.get("align") != "none":
        how += "; rigid alignment by Gauss-Newton least squares (Baker 2004)"
    return (
        f"The loaded image was{before or ', without rigid alignment,'} registered non-rigidly {how}; seed "
        f"{parameters.get('seed')}. The bias field had been removed from both images (N4, Tustison 2010)."
        f"{_labels(parameters.get('labels_from_image'))}"
    )


def _labels(made: Mapping[str, Any] | None) -> str:
    """How the label map was made if that is known: a sentence after a space, or nothing."""
    if not made:
        return ""
    how = "from the unloaded image by mrstrain: skin with a layer model of the brightness below the surface, bones with"
    uncertain = made.get("uncertain", made.get("unsure", np.nan))  # the latter in older records
    doubt = f"{100.0 * uncertain:.0f} % of its voxels had a probability below 90 %"
    return f" The label map was made {how} a watershed, fat and muscle by total variation (Chambolle 2005); {doubt}."


def _files(record: Record) -> str:
    """Software that read the images and wrote the maps of a registration: a sentence after a space, or nothing."""
    if _registration(record) == _GIVEN:
        return ""
    versions, inputs = record.get("versions", {}), record.get("inputs", {})
    formats = sorted({format_of(file["name"]) for role in _IMAGES for file in inputs.get(role, [])})
    images = f"Images ({', '.join(formats)}) were read, and maps (NIfTI, NRRD) were written,"
    code = f"mrstrain, with nibabel {versions.get('nibabel', '?')} for the headers of NIfTI files"
    code += f" and isal {versions.get('isal', '?')} for compression"
    if "DICOM" in formats:
        code += f", pydicom {versions.get('pydicom', '?')} for DICOM (SimpleITK {versions.get('SimpleITK', '?')} "
        code += "for pixel data in a JPEG format; Lowekamp 2013)"
    return f" {images if formats else 'Maps were written'} by {code}."


def _simulated(models: Mapping[str, Path], measured: Mapping[str, Path]) -> list[str]:
    """How models were computed: by mrstrain, from their records; by other programs, from the file formats."""
    sets, driven, others, used = list[str](), list[str](), list[str](), set[str]()
    solvers, levelled = dict[str, list[str]](), dict[str, list[str]]()
    for name, path in models.items():
        record = read_record(path.parent / "simulation.json")
        command, given = record.get("command"), record.get("parameters", {})
        if command == "drive":
            laws = "; ".join(f"{region}: {law}" for region, law in record["laws"].items())
            driven.append(f"{name}: with mrstrain {record.get('versions', {}).get('mrstrain', '?')} ({laws}).")
            used.add(record["set"])
        elif read_record(path.parent / PROVENANCE).get("command") == "level":
            levelled.setdefault(_levelled(path, measured), []).append(name)
        elif command == "simulate" and "set" in given:
            laws = "; ".join(f"{region}: {law['law']}" for region, law in given["laws"].items())
            sets.append(f"{name}: {given['title']} ({laws}).")
            used.add(given["set"])
            solvers.setdefault(_solver(record), []).append(name)
        else:
            others.append(f"{name} ({path.suffix[1:]})")
    ours = " ".join([*(_models(names) + how for how, names in solvers.items()), *sets])
    return [
        *([ours] if sets else []),
        *([f"{_DRIVEN} {' '.join(driven)}"] if driven else []),
        *(["The published material sets are those compiled by Trebbi 2023."] if used & _PUBLISHED else []),
        *(f"{listed(names)}: {how}" for how, names in levelled.items()),
        *([f"Models computed with other programs: {listed(others)}."] if others else []),
    ]


def _models(names: Sequence[str]) -> str:
    return f"The model{'s' * (len(names) > 1)} {listed(names)} {'were' if len(names) > 1 else 'was'} "


_DRIVEN = (
    "Models with measured boundary conditions: each node on the surface of the mesh was moved by the measured "
    "displacement (nodes on the bone were fixed), and the interior was computed from the constitutive models."
)


def _levelled(path: Path, measured: Mapping[str, Path]) -> str:
    """How the measurement was simulated for a model."""
    work = path.parent.with_name(path.parent.name + "-work") / "registered" / path.stem / path.stem
    how = _registration(read_record(work / PROVENANCE))
    same = how in {_registration(read_record(folder / PROVENANCE)) for folder in measured.values()}
    return (
        "forward-model comparison: the unloaded image was denoised and warped by the displacement of the model, new "
        "noise and a new bias field were added, and the pair was registered"
        + (" like the measured images." if same else f" as follows. {how}")
    )


def _along(axes: Sequence[Sequence[float]], column: int, sign: float = 1.0) -> str:
    return "(" + ", ".join(f"{sign * row[column] + 0.0:.3g}" for row in axes) + ")"


def _solver(record: Record) -> str:
    parameters, versions = record["parameters"], record.get("versions", {})
    made = parameters.get("mesh_made")
    mesh = made and (
        f" on a mesh of fTetWild (Hu 2020; pytetwild {made['pytetwild']}; requested edge length {made['edge_mm']:g} mm)"
    )
    loads = listed([f"{step['name']} {LoadStep(**step)}" for path in parameters["paths"] for step in path])
    axes = {load: of.get("plate_axes_lps") for load, of in record.get("outcome", {}).items()}
    if any(own != first for own in axes.values() for first in axes.values()):
        loads += "".join(
            f"; {load} with the plate's outward normal along {_along(own, 0, -1.0)} "
            f"and shear along {_along(own, 1)} (LPS)"
            for load, own in axes.items()
            if own is not None
        )
    contact = "bonded to the plate from first contact on" if parameters.get("taped", True) else "without friction"
    return (
        f"computed with mrstrain {versions.get('mrstrain', '?')}{mesh or ''}: {parameters['element']}; "
        f"plate {parameters['plate']}; skin {contact}; fixed: {', '.join(parameters['fixed'])}; loads {loads}."
    )


def _compared(cells: int, criteria: Criteria) -> str:
    levels = listed([f"{t.max_shear:g}" for t in criteria.thresholds])
    (low, high), version = criteria.strains, versions()["mrstrain"]
    return (
        f"Models and measurement were compared with mrstrain {version} at the centroids of the same {cells} "
        "tetrahedra, weighted by volume, in the reference configuration. The amount of strain was compared by the area "
        f"between the strain-volume curves, for maximum shear strains from {low:g} to {high:g}. Location was compared "
        f"for tissue above {levels}, in clusters of at least {criteria.least_ml:g} mL, by overlap (Dice 1945), "
        "distance of the centroids, and 95th percentile of the Hausdorff distance. Agreement cell by cell was assessed "
        "by regression, concordance (Lin 1989) and limits of agreement (Bland 1986). The modified area validation "
        "metric (Voyles 2015) was computed over all strains, as measured."
    )


def _uncertainty(measured: Mapping[str, Path]) -> str:
    errors = _errors(measured)
    checked = [load for load, of in errors.items() if any(r.get("factor") is not None for r in of.get("twin", []))]
    twin = checked and (
        f"The error bars of {listed(checked)} were checked by a synthetic warp (the unloaded image warped by the "
        "measured displacement, and registered again), and widened where they were too narrow. "
    )
    decomposed = (
        "In each tissue, fields were decomposed into orthonormal polynomials on its cells (CWA 16799:2014), and the "
        "probability that a model represents the measurement within its uncertainty was computed from the coefficients "
        "(Dvurecenska 2018). "
    )
    return (
        f"The intervals (95 % coverage) of areas ({DRAWS} draws) and location ({LOCATION_DRAWS} draws) were computed "
        "from true fields drawn with the error model of the registration (bias and spatially correlated noise). "
        f"{_sources(errors)} {twin or ''}{decomposed}Displacement was compared without intervals."
    )


def models_with(comparison: Comparison, uncertainty: Literal["u_num", "u_input"]) -> list[str]:
    """Models for which this part of the validation uncertainty is known."""
    known = (error.model for error in comparison.errors if not np.isnan(getattr(error, uncertainty)))
    return list(dict.fromkeys(known))


def _of_inputs(comparison: Comparison) -> str:
    """How the input uncertainty of the models was propagated; empty if none was given."""
    by_mesh, by_input = models_with(comparison, "u_num"), models_with(comparison, "u_input")
    if not by_mesh and not by_input:
        return ""
    parts = [f"the inputs of {listed(by_input)}"] if by_input else []
    parts += [f"the mesh of {listed(by_mesh)} (grid convergence index, Roache 1994)"] if by_mesh else []
    return (
        f"The uncertainty of {' and of '.join(parts)} was propagated linearly, from a further solution with each input "
        "changed, and is part of these intervals. The comparison error E = S - D and its standard uncertainties u_num, "
        "u_input and u_D follow ASME V&V 20-2009."
    )


def _sources(errors: Mapping[str, Record]) -> str:
    """Sources of the error models of the registrations, each once."""
    return " ".join(sorted({str(one["source"]) for one in errors.values() if one.get("source")}))


def _errors(measured: Mapping[str, Path]) -> dict[str, Record]:
    """The record on the error of the maximum shear strain, for each registration."""
    return {load: read_record(folder / QUALITY).get("error_of_max_shear", {}) for load, folder in measured.items()}
