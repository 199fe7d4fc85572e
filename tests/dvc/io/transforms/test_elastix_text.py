"""The text of elastix' parameter and transform files: what elastix takes and refuses."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.errors import ParameterError
from dvc.io.transforms.elastix_text import format_parameters, parse_parameters


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("(A 1)\nB 2", "line 2: .* not in brackets"),
        ('(A "b)', "odd number of quotes"),
        ("(A)", "line 1: .* not a parameter name"),
        ("()", "line 1"),
        ("(A.b 1)", "not a parameter name"),
        ("(A 1)\n\n(A 2)", "line 3: .* more than once"),
        ('(File "http://somewhere")', "line 1"),  # elastix cuts comments before it looks at quotes
    ],
)
def test_refuses_lines_that_elastix_refuses(text: str, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        parse_parameters(text)


def test_parse_takes_what_elastix_takes() -> None:
    text = '// head\r\n\t(Metric "A B"\t"C" 4)  // tail\r\n(Empty "")\n(Numbers 1 -2.5e-3)'
    expected = {"Metric": ("A B", "C", "4"), "Empty": (), "Numbers": ("1", "-2.5e-3")}
    assert parse_parameters(text) == expected


def test_format_keeps_every_digit() -> None:
    values = [*np.random.default_rng(9).normal(size=200).tolist(), 5e-324, 1e300, -0.0, 1 / 3]
    again = parse_parameters(format_parameters({"Values": values}))["Values"]
    assert [float(v) for v in again] == values
    with pytest.raises(ParameterError, match="do not allow"):
        format_parameters({"Path": ["//server/file"]})
