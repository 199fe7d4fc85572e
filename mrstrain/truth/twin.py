"""`twin`: somebody's own unloaded image after a deformation of known strain, with the truth beside it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from dvc.atomic_files import write_json
from dvc.io.images.write import write_image
from dvc.io.result_folder import PROVENANCE
from mrstrain.measurement.strain import read_deformation
from mrstrain.records.inputs import make_output, read_subject, refuse_touching_inputs
from phantoms.twin import loaded_twin

_TRUTH = Path("truth") / "twin"
_IMAGE = "twin.nii.gz"


@dataclass(frozen=True, slots=True)
class Twinned:
    """What `twin` gave: the made image, the folder of its truth, and the truth in a line."""

    image: Path
    truth: Path
    strain: str
    shown: float
    register: str

    def summary(self) -> list[str]:
        """A few lines for a person."""
        return [
            f"Made image: {self.image}; {self.shown:.0%} of the tissue is in it. Truth: {self.truth}",
            f"True {self.strain}",
            f"To register it: {self.register}",
        ]


def twin(
    load0: Path | str,
    deformation: Path | str,
    *,
    out: Path | str,
    bone: Path | str | None = None,
    bone_label: str | None = None,
    tissue: Path | str | None = None,
    labels: Path | str | None = None,
    names: Path | str | None = None,
    frame: str | None = None,
    seed: int = 1,
) -> Twinned:
    """Make the loaded image that a deformation would have made of an unloaded one, and write the truth.

    Parameters
    ----------
    load0 : path
        Unloaded image of your own.
    deformation : path
        The whole motion, the foot's own included: an elastix or ITK transform or a displacement image, such as the
        ``TransformParameters.1.txt`` of a load that was registered. It maps points of ``load0`` to the loaded foot.
    out : path
        Gets ``twin.nii.gz`` and ``truth/twin`` in the layout of `register`'s results.
    bone, bone_label, labels, names, tissue, frame
        As in `strain`; the truth is relative to the bone. ``tissue`` is also all that the made image shows.
    seed : int
        Of noise and receive field.

    Returns
    -------
    Twinned

    Raises
    ------
    InputError
        If something does not fit, the deformation folds or leaves the image. Before anything is written.
    """
    target = Path(out)
    subject = read_subject(load0, bone=bone, bone_label=bone_label, tissue=tissue, labels=labels, names=names)
    body = subject.body()
    subject = replace(subject, tissue=body)
    given = read_deformation(
        subject, deformation, frame=frame, command="twin", parameters={"bone_label": bone_label, "seed": seed}
    )
    refuse_touching_inputs(target, [str(_TRUTH), _IMAGE], given.files)
    measured = given.measured(_TRUTH.name)
    make_output(target)
    made = loaded_twin(subject.reference, body, given.whole, near=measured.bone_motion, seed=seed)
    write_image(target / _IMAGE, made.image)
    (target / _TRUTH).parent.mkdir(exist_ok=True)
    measured.write(target / _TRUTH, given.record)
    write_json(target / PROVENANCE, given.record | {"noise_sd": made.noise_sd, "tissue_in_view": made.shown})
    options = {"--bone": bone, "--bone-label": bone_label, "--tissue": tissue, "--labels": labels, "--names": names}
    told = " ".join(f"{option} {value}" for option, value in options.items() if value is not None)
    align = "" if bone is not None or bone_label is not None else " --align none"
    command = f"mrstrain register {load0} {target / _IMAGE} {told}{align} --out {target / 'results'}"
    return Twinned(target / _IMAGE, target / _TRUTH, measured.strain_line, made.shown, command)
