"""Spatial resolution and noise from one pair of images each: a star of shear in a bar of fat and muscle.

Resolution, noise and their product are those of the DIC Challenge 2.0 (Reu and others, Exp Mech 2022,
doi:10.1007/s11340-021-00806-6), with the motion in three dimensions and MR images of tissue in place of speckles.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import isotonic_regression

from dvc import Deformation, Grid, Image, LabelMap, StrainField
from dvc.arrays import FloatArray
from dvc.errors import InputError
from phantoms.anatomy import Heel
from phantoms.bodies import EllipsoidUnion
from phantoms.heel import labels_of, scan
from phantoms.motions import ShearStar

RECOVERED = 0.9
"""Fraction of the amplitude that is recovered at the spatial resolution: a bias of 10 %."""

_CENTRE_MM = np.array([400.0, 0.0, 0.0])  # far from the tendons of the heel, whose textures the bar has
_SHAPE, _SPACING_MM = (160, 72, 72), 0.8
_AMPLITUDE_MM, _PERIODS_MM = 0.6, (4.0, 40.0)
_FAR_MM, _FLAT_MM = 1e5, 2e4  # to bodies that are not in the bar, and radius of the plane between its tissues
_LONG_MM, _AIR_MM = 400.0, 4.0  # half of the bar's length; and air beside it
_MARGIN_MM, _INTERFACE_MM = 8.0, 4.0  # from the ends of the image, and from the interface, that are not sampled
_SAMPLED = 0.5  # of the image's width and height, about the axis of the bar
_BINS = 24  # of the period
_NOISE_STEP = 2  # voxels


@dataclass(frozen=True, slots=True, eq=False)
class StarPair:
    """Images of a bar of tissue, half fat and half muscle: at rest, under a star of shear, and at rest again.

    ``labels`` is on the grid of all three; ``star`` is the true motion from ``reference`` to ``loaded``, LPS mm.
    """

    reference: Image
    loaded: Image
    repeat: Image
    labels: LabelMap
    star: ShearStar


def tissue_bar(seed: int, across_mm: tuple[float, float]) -> Heel:
    """A round bar along x of fat (z < 0) and muscle (z > 0), with the textures of a `Heel`, in air.

    It is centred at (400, 0, 0) mm LPS, with the semi-axes ``across_mm`` along y and z. A surface is needed: where
    tissue fills an image, nothing holds it in the receive field, which differs from scan to scan.
    """
    bar = Heel(seed)

    def ball(centre: Sequence[float], radius: float) -> EllipsoidUnion:
        return EllipsoidUnion.of([(centre, (radius,) * 3, (0.0, 0.0, 0.0))])

    outline = EllipsoidUnion.of([(_CENTRE_MM.tolist(), (_LONG_MM, *across_mm), (0.0, 0.0, 0.0))])
    around, away = ball(_CENTRE_MM.tolist(), _FAR_MM), ball((-_FAR_MM, 0.0, 0.0), 1.0)
    muscle = ball((float(_CENTRE_MM[0]), 0.0, _FLAT_MM), _FLAT_MM)
    bodies = {"outline": outline, "flesh": around, "bone": away, "ankle": away, "muscle": muscle}
    for name, body in bodies.items():
        object.__setattr__(bar, name, body)
    return bar


def star_pair(
    seed: int = 1, shape: tuple[int, int, int] = _SHAPE, spacing_mm: float = _SPACING_MM, snr: float | None = 25.0
) -> StarPair:
    """Images of a bar of tissue in air under a star of shear along z, whose period grows along x from 4 to 40 mm.

    InputError if the SNR is not positive, or the image is too small for the bar.
    """
    if (least := 2.0 * (_AIR_MM + _INTERFACE_MM)) > spacing_mm * min(shape[1:]):
        raise InputError(f"The image of a star must be at least {least:g} mm wide and high; give more voxels (shape).")
    spacing = np.full(3, spacing_mm)
    grid = Grid(shape, spacing, _CENTRE_MM - 0.5 * (np.array(shape) - 1) * spacing, np.eye(3))
    length = shape[0] * spacing_mm - 2.0 * _MARGIN_MM
    x, y = np.eye(3)[:2]
    star = ShearStar(_CENTRE_MM, x, y, _AMPLITUDE_MM, *_PERIODS_MM, length)
    wide, high = (0.5 * n * spacing_mm - _AIR_MM for n in shape[1:])
    bar = tissue_bar(seed, (wide, high))
    reference, repeat = (scan(bar, grid, snr=snr, number=number) for number in (0, 2))
    return StarPair(reference, scan(bar, grid, star, snr=snr, number=1), repeat, labels_of(bar, grid), star)


@dataclass(frozen=True, slots=True)
class StarRow:
    """Fraction of a star's displacement and shear strain that is recovered, by tissue and period (mm)."""

    tissue: str
    period_mm: float
    displacement: float
    strain: float


def star_rows(measured: Deformation, pair: StarPair) -> list[StarRow]:
    """Recovered fraction of the star, by tissue and rising period.

    That of the displacement is taken on the middle plane, where the true displacement is the amplitude everywhere, and
    that of the shear strain E_dn (Green-Lagrange) a quarter of a period to either side, where it is largest.
    Both are means over the direction in which the star does not vary.
    """
    star, rows = pair.star, list[StarRow]()
    grid = pair.labels.grid
    step = float(grid.spacing_mm.min())
    for tissue, depth in _depths(pair).items():
        along = np.arange(-0.5 * star.length_mm, 0.5 * star.length_mm + step / 2, step)
        s, z = (of.ravel() for of in np.meshgrid(along, depth, indexing="ij"))
        middle = star.centre_mm + s[:, None] * star.along + z[:, None] * star.direction
        period = star.period_mm(middle)
        u = measured.displacement(middle) @ star.direction / star.amplitude_mm
        both, strain = 2.0 * np.pi * star.amplitude_mm / period, np.zeros(len(period))  # true E_dn, of both sides
        for side in (1.0, -1.0):
            H = measured.evaluate(middle + side * 0.25 * period[:, None] * star.normal)[1]
            strain -= side * _shear(H, star) / both
        edges = np.linspace(period.min(), period.max(), _BINS + 1)
        bins = np.clip(np.digitize(period, edges) - 1, 0, _BINS - 1)
        for n in np.unique(bins):
            here = bins == n
            rows.append(StarRow(tissue, *(float(np.nanmean(of[here])) for of in (period, u, strain))))
    return rows


def _shear(H: FloatArray, star: ShearStar) -> FloatArray:
    """The component E_dn (n,) of the Green-Lagrange strain of gradients H (n, 3, 3), which the star has."""
    return np.asarray(np.einsum("i,nij,j->n", star.direction, StrainField.from_gradient(H).green_lagrange, star.normal))


def _depths(pair: StarPair) -> dict[str, FloatArray]:
    """Places along the star's direction of the planes of voxels that are sampled, mm from the centre, by tissue."""
    grid = pair.labels.grid
    extent = 0.5 * (grid.shape[2] - 1) * float(grid.spacing_mm[2])
    places = np.arange(-extent, extent + 1e-9, float(grid.spacing_mm[2]))
    inner = places[(np.abs(places) < _SAMPLED * extent) & (np.abs(places) > _INTERFACE_MM)]
    return {"fat": inner[inner < 0.0], "muscle": inner[inner > 0.0]}


@dataclass(frozen=True, slots=True)
class Efficiency:
    """Resolution, noise and their product in one tissue, after the DIC Challenge 2.0; the smaller, the better.

    Attributes
    ----------
    displacement_resolution_mm, strain_resolution_mm : float
        Period from which on 90 % of the amplitude is recovered (bias of 10 %); NaN if it is not within the star's.
    displacement_bias_mm, displacement_noise_mm, strain_bias, strain_noise : float
        Mean and standard deviation between two scans without motion: of the displacement along the star's direction,
        and of the component of the Green-Lagrange strain that the star has, E_dn.
    """

    tissue: str
    displacement_resolution_mm: float
    strain_resolution_mm: float
    displacement_bias_mm: float
    displacement_noise_mm: float
    strain_bias: float
    strain_noise: float

    @property
    def of_displacement_mm2(self) -> float:
        """Metrological efficiency indicator of the displacement: noise times resolution, mm2."""
        return self.displacement_noise_mm * self.displacement_resolution_mm

    @property
    def of_strain_mm2(self) -> float:
        """Metrological efficiency indicator of the strain: noise times squared resolution, mm2."""
        return self.strain_noise * self.strain_resolution_mm**2


def efficiencies(measured: Deformation, still: Deformation, pair: StarPair) -> list[Efficiency]:
    """Efficiency by tissue.

    Parameters
    ----------
    measured, still : Deformation
        From ``reference`` to ``loaded`` of the pair, and to ``repeat``, with the same settings; LPS mm.
    """
    rows, star, made = star_rows(measured, pair), pair.star, list[Efficiency]()
    for tissue, depth in _depths(pair).items():
        mine = [row for row in rows if row.tissue == tissue]
        found = [resolved_mm([r.period_mm for r in mine], [getattr(r, of) for r in mine]) for of in _QUANTITIES]
        grid = pair.labels.grid
        step = _NOISE_STEP * float(grid.spacing_mm.min())
        half = 0.5 * (np.array(grid.shape) - 1) * grid.spacing_mm
        s, y = (np.arange(-reach, reach, step) for reach in (half[0] - _MARGIN_MM, _SAMPLED * half[1]))
        points = np.stack(np.meshgrid(s, y, depth[::_NOISE_STEP], indexing="ij"), axis=-1).reshape(-1, 3)
        axes = np.stack([star.along, star.normal, star.direction])
        u, H = still.evaluate(star.centre_mm + points @ axes)
        along = u @ star.direction
        noise = (float(f(of)) for of in (along, _shear(H, star)) for f in (np.nanmean, np.nanstd))
        made.append(Efficiency(tissue, *found, *noise))
    return made


_QUANTITIES = ("displacement", "strain")


def resolved_mm(periods_mm: Sequence[float], recovered: Sequence[float], share: float = RECOVERED) -> float:
    """Shortest period (mm) from which on a share is recovered, linear between rising periods; NaN if there is none.

    Noise aside, longer periods are recovered better: it is read from the rising curve that fits best (isotonic
    regression).

    Examples
    --------
    >>> resolved_mm([5.0, 10.0, 20.0, 40.0], [0.2, 0.8, 1.0, 1.0])
    15.0
    """
    length, given = np.asarray(periods_mm), np.asarray(recovered)
    if not np.isfinite(given).all():
        return float("nan")
    of = isotonic_regression(given).x
    below = np.flatnonzero(of < share)
    if not len(below) or below[-1] == len(of) - 1:
        return float("nan")
    i = int(below[-1])
    part = (share - of[i]) / (of[i + 1] - of[i])
    return float(length[i] + part * (length[i + 1] - length[i]))
