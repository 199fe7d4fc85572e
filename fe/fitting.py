"""Stretch-stress curves of mechanical tests, and model parameters fitted to them, with intervals of 95 % coverage."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import f as fisher, t as student

from dvc.arrays import FloatArray
from dvc.errors import InputError, few
from dvc.file_names import refuse_path
from dvc.tables import read_table
from fe.hyperelastic import HENCKY, OGDEN, POLYNOMIAL
from fe.materials import HIGHEST_NU, MODES, Hencky, Material, NeoHooke, Ogden, Yeoh, nominal_stress

_EXPONENTS = (-16.0, -8.0, -4.0, -2.0, 2.0, 4.0, 8.0, 16.0)  # starts of an Ogden fit
_MOSTLY = 0.8
_STRETCHES, _MOST_MPA = (0.01, 100.0), 1e6  # far beyond any tissue, and nothing overflows
_MOST = 60.0  # no curve determines an exponent beyond this
_SOFTEST = 1e-3  # least C10 of a polynomial, relative to that of the neo-Hookean model that fits the curves best
_ABSURD = 1e-4  # probability that curves of a material with a positive modulus are refused
_STRESS = {
    "nominal_stress_kpa": (1e-3, False), "nominal_stress_mpa": (1.0, False),
    "true_stress_kpa": (1e-3, True), "true_stress_mpa": (1.0, True),
}  # in MPa, and whether it is true  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A test of an incompressible solid.

    Attributes
    ----------
    mode : str
        One of `fe.materials.MODES`: uniaxial, equibiaxial, pure shear.
    stretch : (n,)
        Length over undeformed length along the loading axis; below 1 in compression.
    stress_mpa : (n,)
        Force over undeformed area, MPa; below 0 in compression.
    """

    mode: str
    stretch: FloatArray
    stress_mpa: FloatArray


def read_curves(path: Path | str, mode: str | None = None) -> list[Curve]:
    """Read the curves of a CSV file, one for each kind of test.

    Columns: ``stretch``; one of ``nominal_stress_kpa``, ``nominal_stress_mpa``, ``true_stress_kpa``,
    ``true_stress_mpa`` (nominal: force over undeformed area; true: over deformed); and ``test``, a name of
    `fe.materials.MODES`, unless ``mode`` gives it for the whole file. Other columns are ignored.

    Raises
    ------
    InputError
        If the file cannot be read, a column is missing or ambiguous, or a value is not a number (the message gives its
        line).
    """
    refuse_path(path)
    columns, rows = read_table(Path(path))
    stress = [c for c in columns if c in _STRESS]
    if "stretch" not in columns or len(stress) != 1:
        raise InputError(
            f"{path}: a curve needs a column 'stretch' (1 + strain) and exactly one of {', '.join(_STRESS)} (kind and "
            f"unit of stress); its columns are {few(columns, most=4) or 'none'}."
        )
    mode = None if mode is None else mode.strip().lower()
    if mode is None and "test" not in columns:
        raise InputError(
            f"{path}: the kind of test is missing. Add a column 'test', or give one test for the whole file "
            f"({', '.join(MODES)})."
        )
    scale, true = _STRESS[stress[0]]
    tests: dict[str, list[tuple[float, float]]] = {}
    for line, row in rows:
        cells = dict(zip(columns, row, strict=True))
        try:
            stretch, value = float(cells["stretch"]), scale * float(cells[stress[0]])
        except ValueError as failure:
            raise InputError(f"{path}, line {line}: {failure}.") from failure
        if not (np.isfinite([stretch, value]).all() and stretch > 0.0):
            raise InputError(
                f"{path}, line {line}: the stretch must be positive, and both numbers must be finite; got {cells}."
            )
        name = mode or cells["test"].lower()
        if name not in MODES:
            raise InputError(f"{path}, line {line}: unknown test '{name}'; available are {', '.join(MODES)}.")
        tests.setdefault(name, []).append((stretch, value / stretch if true else value))
    if not tests:
        raise InputError(f"{path}: the table has no rows below the header.")
    return [Curve(name, *np.array(points).T) for name, points in tests.items()]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A fitted parameter and its 95 % interval."""

    name: str
    value: float
    low: float
    high: float
    at_bound: bool = False  # the unconstrained fit is below the smallest admissible value, and ``value`` is that bound


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A constitutive model fitted to curves.

    Attributes
    ----------
    parameters : tuple of Parameter
        Moduli in MPa; ``mu`` of an Ogden term is its initial shear modulus.
    r2 : mapping of mode to float
        Coefficient of determination by kind of test: 1 minus the residual sum of squares over the total sum of squares.
    rmse_mpa : float
        Of the nominal stress over all points.
    others : tuple of Material
        Other parameters of the same model that fit these curves equally well.
    stable : mapping of mode to (float, float)
        Stretches between which the model is stable, within 1/5 to 5 (`Material.stable_range`).
    reached : mapping of mode to (float, float)
        Smallest and largest stretch of the curves.
    """

    material: Material
    parameters: tuple[Parameter, ...]
    r2: Mapping[str, float]
    rmse_mpa: float
    others: tuple[Material, ...]
    stable: Mapping[str, tuple[float, float]]
    reached: Mapping[str, tuple[float, float]]

    @property
    def stable_where_measured(self) -> bool:
        """Whether the model is stable at every stretch of the curves."""
        return all(self.stable[m][0] <= low and high <= self.stable[m][1] for m, (low, high) in self.reached.items())


@dataclass(frozen=True, slots=True)
class _Law:
    """A constitutive model as it is fitted: class, names of the parameters, and their vector."""

    made: type[Material]
    names: tuple[str, ...]
    vector: Callable[[FloatArray], FloatArray]
    exponents: int = 0  # number of the last parameters, in which the stress is not linear
    bounded: bool = False  # the first parameter is kept positive, and the stress is linear in all parameters


def _polynomial(*names: str) -> _Law:
    return _Law(Yeoh, names, lambda values: np.append(values, np.zeros(OGDEN - len(values))), bounded=True)


def _ogden(terms: int) -> _Law:
    numbers = [""] if terms == 1 else [str(q + 1) for q in range(terms)]
    names = *(f"mu{n}" for n in numbers), *(f"alpha{n}" for n in numbers)
    return _Law(Ogden, names, lambda values: np.append(np.zeros(OGDEN), values.reshape(2, -1).T), terms)


LAWS: Mapping[str, _Law] = {
    "neo-Hooke": _Law(NeoHooke, ("mu",), lambda values: 0.5 * values[0] * np.eye(OGDEN)[POLYNOMIAL]),
    "Isihara": _polynomial("C10", "C20"),
    "Yeoh": _polynomial("C10", "C20", "C30"),
    "Ogden": _ogden(1),
    "Ogden-2": _ogden(2),
    "Ogden-3": _ogden(3),
    "Hencky": _Law(Hencky, ("mu",), lambda values: values[0] * np.eye(OGDEN)[HENCKY]),
}
"""Constitutive models that can be fitted. Isihara is Yeoh without C30."""


def fit(curves: Sequence[Curve], law: str, nu: float = 0.4999) -> Fit:
    """Fit a constitutive model to curves of an incompressible solid by least squares of the nominal stress.

    Parameters
    ----------
    curves : sequence of Curve
        All are fitted together, every point with the same weight.
    law : str
        A name of `LAWS`; case is ignored.
    nu : float
        Poisson's ratio of the resulting material; the fit itself assumes that the tissue is incompressible.

    Raises
    ------
    InputError
        If there are too few points or too few stretches other than 1; if the curves do not determine the parameters, or
        imply an initial shear modulus that is not positive.

    Notes
    -----
    The curve of one test may not determine the exponents: in uniaxial compression, alpha and about -alpha / 2 give
    nearly the same stress. Among optima that an F test at 5 % does not distinguish, one with only positive exponents is
    chosen, and the others are reported.

    Intervals are those of linearised regression with Student's t. They assume independent errors of equal standard
    deviation; an error that all points of a curve share, such as a wrong area, is not covered. Fits of Ogden exponents
    start from the four best combinations of eight values.

    C10, half the initial shear modulus, must be positive, but a curve that is steep only at its end may not determine
    it. Its lower bound is a thousandth of C10 of the best neo-Hookean fit. Let w be the half width of a parameter's
    interval without the bound. With the bound, the interval extends from w below the lower to w above the higher of the
    two values with and without the bound; that of C10 ends at 0. Its coverage is therefore at least as high. Curves are
    refused if C10 is so far below 0 that this would occur by chance in less than one of 10,000 curves of a valid model.
    """
    sought, curves = _checked(curves, law, nu)
    count = len(sought.names)
    stress = np.concatenate([c.stress_mpa for c in curves])
    size = float(np.sqrt(np.mean(stress**2)))

    def modelled(values: FloatArray) -> FloatArray:
        return np.concatenate([nominal_stress(sought.vector(values), c.stretch, c.mode) for c in curves])

    optima: list[OptimizeResult] = []
    for start in _starts(sought, modelled, stress):
        scales = np.where(np.arange(count) < count - sought.exponents, np.maximum(np.abs(start), 1e-3 * size), 1.0)
        with np.errstate(over="ignore", invalid="ignore"):
            optimum = least_squares(
                lambda v: np.nan_to_num((modelled(v) - stress) / size, nan=1e6, posinf=1e6, neginf=-1e6),
                start, jac="3-point", x_scale=scales, xtol=1e-14, ftol=1e-14, gtol=1e-14,
            )  # fmt: skip
        optima.append(optimum)
    best, others = _chosen(sought, optima, len(stress))
    if sought.exponents and np.abs(best.x[-sought.exponents :]).max() > _MOST:
        raise InputError(
            f"{law}: these curves do not determine the exponents (the best fit exceeds {_MOST:g}). Use fewer terms."
        )
    deviations = _deviations(best.x, best.jac, best.fun)
    if deviations is None:
        raise InputError(
            f"{law}: these curves do not determine the parameters (singular system). Use a model with fewer parameters."
        )
    values, parameters = _with_intervals(sought, best, deviations, curves, stress)
    try:
        material = sought.made(sought.vector(values), nu)
    except InputError as unusable:
        raise InputError(
            f"{law}: the best fit is not a valid material. {unusable} Add points closer to a stretch of 1, or use a "
            "model with fewer parameters."
        ) from unusable
    residual = modelled(values) - stress
    return Fit(
        material, parameters, _r2(curves, residual), float(np.sqrt(np.mean(residual**2))),
        others=tuple(sought.made(sought.vector(o.x), nu) for o in others),
        stable={mode: material.stable_range(mode) for mode in MODES},
        reached={c.mode: (float(min(1.0, c.stretch.min())), float(max(1.0, c.stretch.max()))) for c in curves},
    )  # fmt: skip


def _checked(curves: Sequence[Curve], law: str, nu: float) -> tuple[_Law, list[Curve]]:
    """The model of that name, and one curve for each kind of test; InputError if they cannot be used."""
    named = {name.lower(): name for name in LAWS}
    if law.lower() not in named:
        raise InputError(f"Unknown model '{law}'; models that can be fitted are {', '.join(LAWS)}.")
    if not 0.0 <= nu <= HIGHEST_NU:
        raise InputError(f"Poisson's ratio must be between 0 and {HIGHEST_NU}; got {nu:g}.")
    sought, joined = LAWS[named[law.lower()]], []
    for mode in dict.fromkeys(curve.mode for curve in curves):
        mine = [curve for curve in curves if curve.mode == mode]
        joined.append(Curve(mode, *(np.concatenate([getattr(c, a) for c in mine]) for a in ("stretch", "stress_mpa"))))
    stretch, stress = np.hstack([np.empty((2, 0)), *([c.stretch, c.stress_mpa] for c in joined)])
    count = len(sought.names)
    apart = len(np.unique(np.round(stretch[np.abs(stretch - 1.0) > 1e-6], 9)))
    if len(stress) < count + 2 or apart < count:
        raise InputError(
            f"{law} has {count} parameters. It needs at least {count + 2} points and {count} different stretches other "
            f"than 1; got {len(stress)} points and {apart} such stretches."
        )
    if np.mean(stress * (stretch - 1.0) < 0.0) > _MOSTLY:
        raise InputError(
            "The stress has the wrong sign: it must be positive in tension (stretch above 1) and negative in "
            "compression (stretch below 1). If the column contains strain, convert it: stretch = 1 + strain."
        )
    if not (_STRETCHES[0] <= stretch.min() and stretch.max() <= _STRETCHES[1]):
        raise InputError(
            f"Stretches must be between {_STRETCHES[0]:g} and {_STRETCHES[1]:g}; the curves have {stretch.min():g} to "
            f"{stretch.max():g}. The stretch is the deformed length over the undeformed one."
        )
    if np.abs(stress).max() > _MOST_MPA:
        raise InputError(
            f"A stress of {np.abs(stress).max():g} MPa is beyond any tissue. Check its unit (column name) and the rows "
            "of the table."
        )
    if not stress.any():
        raise InputError("The stress is 0 at every point of the curves.")
    return sought, joined


def _with_intervals(
    law: _Law, best: OptimizeResult, deviations: FloatArray, curves: Sequence[Curve], stress: FloatArray
) -> tuple[FloatArray, tuple[Parameter, ...]]:
    """The best values, with the first kept positive if required, and their 95 % intervals."""
    values, least = best.x, np.full(len(best.x), -np.inf)
    freedom = len(stress) - len(values)
    widths = student.ppf(0.975, freedom) * deviations
    if law.bounded:
        absurd = values[0] + student.isf(_ABSURD, freedom) * deviations[0] <= 0.0
        if values[0] <= widths[0] and not absurd:  # its interval contains zero: the curves do not determine it
            size = float(np.sqrt(np.mean(stress**2)))
            unit = np.concatenate([nominal_stress(np.eye(OGDEN)[0], c.stretch, c.mode) for c in curves])
            softest = _SOFTEST * float(unit @ stress / (unit @ unit))  # not positive if no positive modulus fits
            columns = best.jac * size  # their product with the values is the stress
            if values[0] < softest:
                rest, *_ = np.linalg.lstsq(columns[:, 1:], stress - columns[:, 0] * softest, rcond=None)
                values = np.array([softest, *rest])
        least[0] = 0.0
    low, high = np.maximum(np.minimum(values, best.x) - widths, least), np.maximum(values, best.x) + widths
    at_bound = (least > -np.inf) & (values > best.x)
    return values, tuple(
        Parameter(name, float(values[n]), float(low[n]), float(high[n]), bool(at_bound[n]))
        for n, name in enumerate(law.names)
    )


def _r2(curves: Sequence[Curve], residual: FloatArray) -> dict[str, float]:
    """Fraction of the variance of the stress that the model explains, by kind of test."""
    r2, ends = {}, np.cumsum([len(c.stress_mpa) for c in curves])
    for curve, left in zip(curves, np.split(residual, ends[:-1]), strict=True):
        spread = float(((curve.stress_mpa - curve.stress_mpa.mean()) ** 2).sum())
        r2[curve.mode] = 1.0 - float((left**2).sum()) / spread if spread > 0 else float("nan")
    return r2


def _starts(law: _Law, modelled: Callable[[FloatArray], FloatArray], stress: FloatArray) -> list[FloatArray]:
    """First guesses: moduli by linear least squares, for each combination of exponents."""
    linear = len(law.names) - law.exponents
    starts = []
    for exponents in itertools.combinations(_EXPONENTS, law.exponents):
        columns = np.column_stack([modelled(np.array([*unit, *exponents])) for unit in np.eye(linear)])
        moduli, *_ = np.linalg.lstsq(columns, stress, rcond=None)
        starts.append((float(((columns @ moduli - stress) ** 2).sum()), np.array([*moduli, *exponents])))
    return [start for _, start in sorted(starts, key=lambda pair: pair[0])[:4]]


def _chosen(
    law: _Law, optima: Sequence[OptimizeResult], points: int
) -> tuple[OptimizeResult, tuple[OptimizeResult, ...]]:
    """The reported optimum, and those that the data do not distinguish from it."""
    ranked = sorted(optima, key=lambda o: o.cost)
    different: list[OptimizeResult] = []
    freedom, exponents = points - len(law.names), slice(len(law.names) - law.exponents, None)
    limit = ranked[0].cost * (1.0 + fisher.ppf(0.95, 1, freedom) / freedom)
    for optimum in ranked:
        near = [np.allclose(optimum.x, other.x, rtol=1e-3, atol=1e-9) for other in different]
        if optimum.cost <= limit and not any(near) and law.vector(optimum.x)[OGDEN::2].min(initial=0.0) >= 0.0:
            different.append(optimum)
    best, *others = sorted(different or ranked[:1], key=lambda o: not (o.x[exponents] > 0.0).all())
    return best, tuple(others)


def _deviations(values: FloatArray, jacobian: FloatArray, residual: FloatArray) -> FloatArray | None:
    """Standard deviations of the values; None if the curves do not determine them."""
    scaled = jacobian * np.maximum(np.abs(values), 1e-300)
    lengths = np.linalg.norm(scaled, axis=0)
    if not (lengths > 0.0).all():
        return None
    _, sizes, right = np.linalg.svd(scaled / lengths, full_matrices=False)
    if sizes[-1] < 1e-10 * sizes[0]:
        return None
    freedom = len(residual) - len(values)
    variance = float(residual @ residual) / freedom
    covariance = variance * (right.T / sizes**2) @ right
    return np.asarray(np.sqrt(np.diag(covariance)) / lengths * np.abs(values))
