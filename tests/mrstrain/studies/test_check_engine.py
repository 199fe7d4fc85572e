"""`check`: what the registration of a study would refuse, its engine and its error model, is reported before a run."""

from __future__ import annotations

from dvc.trust.error_model import error_model_of
from tests.mrstrain.studies.checked_study import wrong

MINE = ('"mine.toml", ', "")


def test_an_error_model_of_another_engine_is_a_problem(study):
    for preset in ("gauss-newton", "gauss-newton-borders"):
        error_model_of(preset).write(study / f"{preset}.json")
    other = ("[registration]", '[registration]\nerror_model = "gauss-newton.json"')
    told = wrong(study, MINE, other)
    assert "error_model" in told
    assert "this error model is for gauss-newton, but gauss-newton-borders will be used" in told
    assert "mrstrain accuracy --preset gauss-newton-borders" in told
    assert wrong(study, MINE, ("[registration]", '[registration]\nerror_model = "gauss-newton-borders.json"')) == ""
