"""`fit`: a constitutive model fitted to a stress-stretch curve, with intervals, a figure and a material set."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import fe
from dvc.atomic_files import write_csv, write_json, write_whole
from dvc.report.drawing import save_figure
from fe import Fit, Material, Ogden, as_toml, figures, read_curves
from fe.hyperelastic import OGDEN
from mrstrain.records.inputs import alone, output_folder, refuse_touching_inputs
from mrstrain.records.provenance import provenance

_FILES = ["fit.json", "fit.csv", "fit.png", "fit.pdf", "material.toml"]


@dataclass(frozen=True, slots=True)
class Fitted:
    """Result of `fit`, and its folder."""

    out: Path
    fit: Fit

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        fitted = self.fit
        lines, doubts = [fitted.material.description], []
        for p in fitted.parameters:
            scale, unit = (1.0, "") if p.name.startswith("alpha") else (1000.0, " kPa")
            low, high = scale * p.low, scale * p.high
            lines.append(f"  {p.name} {scale * p.value:.4g}{unit} (95 % interval {low:.4g} to {high:.4g})")
            unknown = f"These curves do not determine {p.name}:"
            if p.at_bound:
                doubts.append(
                    f"{unknown} the best fit is below the smallest allowed value, which is used instead. Measure "
                    "closer to a stretch of 1, or use a model with fewer parameters."
                )
            elif p.low <= 0.0 <= p.high:
                doubts.append(f"{unknown} its interval includes 0. Use a model with fewer parameters.")
        lines.append("R2 " + ", ".join(f"{mode} {r2:.4f}" for mode, r2 in fitted.r2.items()))
        for mode, (low, high) in fitted.reached.items():
            stable = "stable from {:.3g} to {:.3g}".format(*fitted.stable[mode])
            lines.append(f"{mode}: measured at stretches {low:.3g} to {high:.3g}, {stable}")
        lines += [*_in_programs(fitted.material), *doubts]
        if not fitted.stable_where_measured:
            lines.append(
                "WARNING: the model is not stable (Drucker) at every measured stretch. Use another model, or simulate "
                "smaller strains."
            )
        lines += [f"Equally good fit to these curves: {other.description}" for other in fitted.others]
        return [*lines, f"Results: {self.out}"]


def _in_programs(law: Material) -> list[str]:
    """The parameters of an Ogden model in the conventions of three programs, kPa."""
    if not isinstance(law, Ogden):
        return []
    pairs = law.vector[OGDEN:].reshape(-1, 2).tolist()
    moduli = {
        "ANSYS (mu, alpha)": [2000.0 * mu / alpha for mu, alpha in pairs],
        "Abaqus, CalculiX (mu, alpha)": [1000.0 * mu for mu, _ in pairs],
        "FEBio (c, m)": [2000.0 * mu for mu, _ in pairs],
    }
    return [
        f"  as {program}: " + "; ".join(f"{mu:.4g} kPa, {alpha:.4g}" for mu, (_, alpha) in zip(of, pairs, strict=True))
        for program, of in moduli.items()
    ]


def fit(
    curve: Path | str, law: str, *, out: Path | str, test: str | None = None, nu: float = 0.4999, tissue: str = "fat"
) -> Fitted:
    """Fit a constitutive model to the curves of a CSV file.

    Parameters
    ----------
    curve : path
        As in `fe.read_curves`: stretch, and nominal or true stress in kPa or MPa.
    law : str
        A name of `fe.LAWS`.
    out : path
        Gets ``fit.json``, ``fit.csv`` (measured and fitted), its figure ``fit.png`` and ``fit.pdf``, and
        ``material.toml``, a material set with the fitted model.
    test : str, optional
        Kind of test if the file has no column for it: uniaxial, equibiaxial, pure shear.
    nu : float
        Poisson's ratio for simulations; the fit assumes that the tissue is incompressible.
    tissue : str
        Tissue of the model in ``material.toml``.

    Raises
    ------
    InputError
        If the file or its curves cannot be used; before anything is written.
    """
    path, target = Path(curve), Path(out)
    curves = read_curves(path, test)
    fitted = fe.fit(curves, law, nu)
    refuse_touching_inputs(target, _FILES, [path])
    about = {
        "material": fitted.material.description,
        "others": [other.description for other in fitted.others],
        "mu_of_ogden": "initial shear modulus of the term, MPa (Abaqus' convention)",
        "in_programs": [line.strip() for line in _in_programs(fitted.material)],
        "stable_where_measured": fitted.stable_where_measured,
        "provenance": provenance("fit", {"curve": path}, {"law": law, "test": test, "nu": nu, "tissue": tissue}),
    }
    rows = []
    for c in curves:
        modelled = 1000.0 * fitted.material.nominal_stress(c.stretch, c.mode)
        numbers = np.column_stack([c.stretch, 1000.0 * c.stress_mpa, modelled])
        rows += [[c.mode, *(f"{value:.8g}" for value in row)] for row in numbers]
    source = f"{law} fitted to {path.name}"
    if at_bound := [p.name for p in fitted.parameters if p.at_bound]:
        source += f", which does not determine {', '.join(at_bound)}"
    with output_folder(target), alone(target):
        write_json(target / "fit.json", asdict(fitted) | about)
        write_csv(target / "fit.csv", ("test", "stretch", "nominal_stress_kpa", "fitted_kpa"), rows)
        save_figure(target / "fit", figures.stress_stretch(curves, fitted))
        write_whole(target / "material.toml", as_toml(path.stem, source, {tissue: fitted.material}))
    return Fitted(target, fitted)
