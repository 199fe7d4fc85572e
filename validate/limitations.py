"""What limits a comparison: of each measurement, and models that cover little of the mesh."""

from collections.abc import Sequence

import numpy as np

from validate.load_comparison import LoadComparison

_COVERED = 0.9  # fraction of the mesh; a model that covers less is noted


def limitations(loads: Sequence[LoadComparison]) -> list[str]:
    """Limitations of each measurement, and models that cover little of the mesh, as sentences."""
    notes = []
    for one in loads:
        load, error, volumes = one.load, one.case.error, one.fields.coverage()
        if one.case.aligned_on == "none":
            what = "the rigid motion of the bone was not removed from this measurement, so displacements include it."
            notes.append(f"{load}: {what}")
        if gaps := ", ".join(one.case.without_intervals):
            notes.append(f"{load}: no intervals in {gaps}; the report of the measurement says why.")
        if error is not None and np.isnan(error.widening):
            what = "the error model is from one motion of one subject, so the coverage of its intervals is unknown."
            notes.append(f"{load}: {what}")
        notes += [
            f"{load}: {name} covers only {100 * volumes[name] / volumes['mesh']:.0f} % of the mesh. All models are "
            "compared on the tissue that every model covers."
            for name in one.fields.models
            if volumes[name] < _COVERED * volumes["mesh"]
        ]
    if unknown := ", ".join(one.load for one in loads if one.case.error is None):
        what = "the measurement has no error model, so its uncertainty is unknown"
        if not loads[0].bones:
            what = "the error model needs the distance to bone, so the measurement uncertainty is unknown"
            soft = ", ".join(loads[0].labels.names.values())
            notes.append(f"The label map has no bone; all of its labels ({soft}) are compared as soft tissue.")
        notes.append(f"{unknown}: {what}, and no difference can be tested for significance.")
    return notes
