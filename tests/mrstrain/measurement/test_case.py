"""The report of a series of loads: its verdict."""

from __future__ import annotations

from dvc.report.page import Section
from dvc.trust.verdict import Verdict
from mrstrain.measurement.case import Case, Series


def test_the_verdict_on_a_series_names_the_load_of_each_reason(tmp_path):
    thick, folded = Verdict("caution", ("Slices are 3 mm apart.",)), Verdict("distrust", ("It folds.",))
    cases = tuple(
        Case(tmp_path, Section(name, verdict), (), "") for name, verdict in (("Load1", folded), ("Load2", thick))
    )
    for count, told in ((2, "Load1, registration (Do not trust): It folds."), (1, "It folds.")):
        Series.of(tmp_path, cases[:count], {}, {})
        head = (tmp_path / "report.html").read_text().split("<h1>")[1].split("<details", maxsplit=1)[0]
        assert f"<li>{told}</li>" in head
