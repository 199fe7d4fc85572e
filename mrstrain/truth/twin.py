"""`twin`: synthetic warp of a subject's own unloaded image by a given deformation, with the truth beside it."""

from dataclasses import replace
from pathlib import Path

from dvc import Measurement, write_image
from dvc.atomic_files import write_json
from dvc.file_names import as_typed
from dvc.io.result_folder import PROVENANCE
from mrstrain.measurement.strain import read_any
from mrstrain.options.door import door
from mrstrain.options.measurement import ExistingFiles, Frame
from mrstrain.records.inputs import alone, output_folder, read_subject, refuse_touching_inputs
from mrstrain.records.outcome import Outcome
from mrstrain.records.provenance import provenance
from phantoms import Acquisition, synthetic_warp

_TRUTH = Path("truth") / "twin"
_IMAGE = "twin.nii.gz"


@door
def twin(
    load0: Path | str, deformation: Path | str, *, out: Path | str, subject_files: ExistingFiles,
    frame: Frame | None = None, seed: int = 1,
) -> Outcome:  # fmt: skip
    """Warp an unloaded image by a deformation, as if it had been scanned under load, and write the truth.

    Parameters
    ----------
    load0 : path
        Unloaded image.
    deformation : path
        Total motion, rigid motion included: an elastix or ITK transform or a displacement image, such as the
        ``transform.h5`` of a registered load. It maps points of ``load0`` to the loaded image, LPS mm.
    out : path
        Gets ``twin.nii.gz`` and ``truth/twin`` in the layout of `register`'s results.
    subject_files, frame
        As in `strain`; the truth is relative to the bone. ``tissue`` is also all that the warped image shows.
    seed : int
        Of noise and bias field.

    Raises
    ------
    InputError
        Before anything is written: if the inputs do not fit together, or the deformation folds or leaves the image.
    """
    target, source = Path(out), Path(deformation)
    subject = read_subject(load0, subject_files)
    subject = replace(subject, tissue=subject.body())
    total = read_any(source, frame)
    parameters = {"frame": frame, "bone_label": subject_files.bone_label, "seed": seed}
    record = provenance("twin", {**subject.files, "deformation": source}, parameters)
    refuse_touching_inputs(target, [str(_TRUTH), _IMAGE], [source, *subject.files.values()])
    measured = Measurement.from_deformation(total, subject, name=_TRUTH.name)
    with output_folder(target), alone(target):
        made = synthetic_warp(subject.reference, subject.body(), total, Acquisition(seed), near=measured.bone_motion)
        write_image(target / _IMAGE, made.image)
        (target / _TRUTH).parent.mkdir(exist_ok=True)
        measured.write(target / _TRUTH, record)
        write_json(target / PROVENANCE, record | {"noise_sd": made.noise_sd, "tissue_in_view": made.shown})
    told = " ".join(
        f"{subject_files.option(name)} {as_typed(value)}" for name, value in subject_files if value is not None
    )
    align = " --align none" if subject.bone is None else ""
    lines = (
        f"Warped image: {target / _IMAGE}; it shows {100 * made.shown:.0f} % of the tissue. Truth: {target / _TRUTH}",
        f"True {measured.strain_line}",
        "To register it:",
        f"mrstrain register {as_typed(load0)} {as_typed(target / _IMAGE)} {told}{align} "
        f"--out {as_typed(target / 'results')}",
    )
    return Outcome(target, lines)
