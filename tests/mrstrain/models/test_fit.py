"""`mrstrain fit`: a CSV in; parameters, picture and a material set out; refusals in sentences."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.errors import InputError
from fe import material_set
from mrstrain.cli.app import app
from mrstrain.models.fit import fit

pytestmark = pytest.mark.usefixtures("real_pictures")


def write_curve(path: Path) -> Path:
    stretch = np.linspace(0.5, 1.0, 25)
    stress = 1000.0 * material_set("trebbi").materials["fat"].nominal_stress(stretch)
    path.write_text(
        "stretch,nominal_stress_kpa\n" + "".join(f"{a},{b}\n" for a, b in zip(stretch, stress, strict=True))
    )
    return path


def test_the_set_it_writes_is_the_law_that_made_the_curve(tmp_path: Path) -> None:
    curve = write_curve(tmp_path / "heel fat.csv")
    out = tmp_path / "out"
    given = [str(curve), "--law", "Ogden", "--test", "uniaxial", "--tissue", "fat", "--out", str(out)]
    done = CliRunner().invoke(app, ["fit", *given])
    assert done.exit_code == 0, done.output
    assert "Ogden, mu0 10.54 kPa, alpha 6.2" in done.output
    law = material_set(out / "material.toml").materials["fat"]
    assert law.vector == pytest.approx(material_set("trebbi").materials["fat"].vector, rel=1e-8)
    told = json.loads((out / "fit.json").read_text())
    assert told["parameters"][1]["value"] == pytest.approx(6.2)
    assert told["provenance"]["inputs"]["curve"][0]["name"] == "heel fat.csv"
    assert (out / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "fit.pdf").read_bytes().startswith(b"%PDF")
    rows = np.genfromtxt(out / "fit.csv", delimiter=",", skip_header=1, usecols=(1, 2, 3))
    assert rows[:, 1] == pytest.approx(rows[:, 2], abs=1e-6)


def test_a_modulus_at_its_bound_is_told_and_goes_with_the_set(tmp_path: Path) -> None:
    stretch = np.linspace(1.0, 1.4, 30)
    muscle = material_set("trebbi").materials["muscle"].nominal_stress(stretch)
    stress = muscle + np.random.default_rng(0).normal(0.0, 0.03 * muscle.max(), 30)
    curve = tmp_path / "muscle.csv"
    rows = "".join(f"{a},{b}\n" for a, b in zip(stretch, stress, strict=True))
    curve.write_text("stretch,nominal_stress_mpa\n" + rows)
    done = fit(curve, "Yeoh", out=tmp_path / "out", test="uniaxial", tissue="muscle")
    assert [p.at_bound for p in done.fit.parameters] == [True, False, False]
    assert (
        sum("do not determine C10: the best fit is below the smallest allowed value" in line for line in done.summary())
        == 1
    )
    told = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert told["parameters"][0]["at_bound"] is True
    assert told["parameters"][0]["low"] == 0.0
    assert "does not determine C10" in (tmp_path / "out" / "material.toml").read_text()


def test_a_curve_without_its_test_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    curve, out = write_curve(tmp_path / "fat.csv"), tmp_path / "out"
    with pytest.raises(InputError, match="the kind of test is missing"):
        fit(curve, "Ogden", out=out)
    assert not out.exists()


def test_the_results_do_not_replace_the_curve(tmp_path: Path) -> None:
    curve = write_curve(tmp_path / "fit.csv")
    before = curve.read_bytes()
    with pytest.raises(Exception, match=r"fit\.csv"):
        fit(curve, "Ogden", test="uniaxial", out=tmp_path)
    assert curve.read_bytes() == before


@pytest.mark.parametrize("name", ["luboz", "trebbi", "akrami"])
def test_sets_survive_being_written(tmp_path: Path, name: str) -> None:
    from fe import as_toml

    file = tmp_path / "again.toml"
    laws = material_set(name).materials
    file.write_text(as_toml("a set, with spaces", "x", laws))
    again = material_set(file).materials
    assert {t: law.description for t, law in again.items()} == {t: law.description for t, law in laws.items()}
