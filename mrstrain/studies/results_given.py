"""Checks of the results of other codes that a study names, and of the variants of its models."""

from collections.abc import Callable
from typing import Any

from dvc import LabelMap
from dvc.measurement.subject import bones_of
from mrstrain.comparison.model_files import model_files
from mrstrain.models.variant_files import variant_folders
from mrstrain.options.modelling import ModelReading
from mrstrain.studies.file import Study
from validate import check_in_tissue


def look_at_results(study: Study, labels: LabelMap | None, tried: Callable[..., Any]) -> list[str]:
    """Read what says which input of a variant changed, and every result, which must lie in the labelled soft tissue.

    Returns sentences on what is left out; what is wrong is collected by ``tried``.
    """
    tried(variant_folders, [study.path(place) for place in study.uncertainty.variants])
    if labels is None or not study.models.results:
        return []
    reading, bones = ModelReading(unfinished=study.models.unfinished), bones_of(labels, study.mesh.bones)
    files, notes = model_files(list(study.loads), [study.path(p) for p in study.models.results], reading)
    for file in (file for of in files.values() for file in of):
        if (result := tried(file.read, labels.grid)) is not None:
            tried(check_in_tissue, file.path, result.mesh, labels, bones)
    return notes
