"""Figures of a registration: slices in three planes through a point, and curves.

All panels of a figure share one scale, so a length is the same everywhere; `dvc.report.sheet` tells how slices lie on
the page. Yellow marks at a panel's edge show where the other planes cut. Voxels without a value are never drawn as
zero: the loaded image is dark blue there, a map leaves the image below it plain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, NullLocator
from scipy.ndimage import map_coordinates

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.errors import GeometryError, InputError
from dvc.images.image import Image, LabelMap, Mask
from dvc.report.chart import chart, label_axes, legend
from dvc.report.sheet import AXES, PLANES, UNSEEN, Plane, Sheet, Values, View, levelled, window_of
from dvc.report.style import BAND, BOLD, ON_DARK, TISSUES, looks
from dvc.trust.regions import volume_above

MAX_SHEAR = "maximum shear strain (E₁ − E₃)/2, no unit"
SIGMA = "standard uncertainty of the maximum shear strain, no unit"
_DISPLACEMENT = "displacement magnitude relative to the bone, mm"
_COLOURS = {  # what is drawn with its unit, and the name of its colour map
    "max_shear": (MAX_SHEAR, "viridis"), "sigma": (SIGMA, "cividis"), "displacement_mm": (_DISPLACEMENT, "viridis"),
    "jacobian": ("volume ratio det F, no unit", "PuOr_r"),
}  # fmt: skip
_ENDS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_STAGES = ("Before: rigidly aligned", "After: registered")
_CHECK_MM = 12.0
_LINE_MM = 5.0
_HIGHEST_SHEAR = 0.6
_LEAST_SCALE, _MOST_SCALE = 0.05, 0.5  # ends of the colours of the maximum shear strain
_DRAWN = np.linspace(0.0, _HIGHEST_SHEAR, 1501)  # finer than a dot of the figure
_WRITTEN = np.linspace(0.0, _HIGHEST_SHEAR, 121)


def overlay(view: View, reference: Image, rigid: Float32Array, registered: Float32Array) -> Figure:
    """Unloaded image in green, loaded image in magenta; before and after the non-rigid part of the registration.

    Grey: both images agree. A faint tint over a whole region comes from different bias fields. Coloured rims
    are edges that do not coincide. Yellow marks show the positions of the other slices. Dark blue: not in the loaded
    image.
    """
    sheet = Sheet(view, _STAGES)
    for plane, axes, green, magenta in _beside(sheet, reference, (rigid, registered)):
        page = np.stack([magenta, green, magenta], axis=-1)
        page[np.isnan(page).any(axis=-1)] = UNSEEN
        sheet.paint(plane, axes, page)
    return sheet.finished()


def checkerboard(view: View, reference: Image, rigid: Float32Array, registered: Float32Array) -> Figure:
    """Squares of 12 mm, alternately from the unloaded and the loaded image; before and after the non-rigid part.

    Where the registration is correct, edges continue across the squares without a step.
    """
    sheet, spacing = Sheet(view, _STAGES), view.grid.toward_lps().spacing_mm
    for plane, axes, a, b in _beside(sheet, reference, (rigid, registered)):
        _, across, along = AXES[plane]
        down, right = np.indices(a.shape)
        odd = (down * spacing[along] // _CHECK_MM + right * spacing[across] // _CHECK_MM) % 2 == 1
        page = np.repeat(np.where(odd, b, a)[..., None], 3, axis=-1)
        page[np.isnan(page[..., 0])] = UNSEEN
        sheet.paint(plane, axes, page)
    return sheet.finished()


def _beside(
    sheet: Sheet, reference: Image, carried: Sequence[Float32Array]
) -> Iterator[tuple[Plane, Axes, FloatArray, FloatArray]]:
    """Each panel of a sheet that has a row for each carried image: pages of the unloaded image and that one, 0 to 1."""
    window = window_of(sheet.view, reference.values)
    for row, values in zip(sheet.rows, carried, strict=True):
        own = window_of(sheet.view, values)
        for plane, axes in row.items():
            page = levelled(sheet.view.cut(reference.values, plane), window)
            yield plane, axes, page, levelled(sheet.view.cut(values, plane), own)


def strain_slices(
    view: View, reference: Image, max_shear: Float32Array, largest: float, outline: LabelMap | None = None
) -> Figure:
    """Maximum shear strain (E1 - E3)/2 in colour over the unloaded image, in the reference configuration.

    Thin white lines are the outlines of the regions. Grey: no result.
    """
    return coloured(view, reference, max_shear, Scale.of("max_shear", max_shear, largest), outline=outline).finished()


def image_slices(
    view: View, image: Image, max_shear: Float32Array, largest: float, outline: LabelMap | None = None
) -> Figure:
    """An MR image in grey, with all that `strain_slices` draws but the colours: these alone fade between the two."""
    scale = Scale.of("max_shear", max_shear, largest)
    return coloured(view, image, max_shear, scale, outline=outline, bare=True).finished()


def sigma_slices(view: View, reference: Image, sigma: Float32Array, largest: float) -> Figure:
    """Standard uncertainty of the maximum shear strain in colour over the unloaded image, from the error model.

    It is the standard deviation of the error about its bias (bias_max_shear.nii.gz): with the expanded uncertainty U,
    the true value is expected within measured - bias ± U. Grey: bone, or no result.
    """
    return coloured(view, reference, sigma, Scale.of("sigma", sigma, largest)).finished()


@dataclass(frozen=True, slots=True)
class Scale:
    """Colours of a scalar: what it is with its unit, the name of the colour map, and the values at its ends."""

    told: str
    shades: str
    low: float
    high: float

    @classmethod
    def of(cls, quantity: str, values: Values, largest: float | None = None) -> Self:
        """Colours of a quantity, to ``largest`` (positive), or to a round number that 99 % of its values lie within.

        Those of the maximum shear strain end at `shear_scale`.
        """
        if largest is not None and not largest > 0.0:
            raise InputError(f"The upper end of the colour scale (largest) must be positive; got {largest}.")
        component = f"Green-Lagrange strain, component {quantity} in LPS, no unit", "PuOr_r"
        told, shades = _COLOURS.get(quantity, component)
        if quantity == "jacobian":
            reach = largest or volume_reach(values)
            return cls(told, shades, 1.0 - reach, 1.0 + reach)
        if quantity == "max_shear":
            return cls(told, shades, 0.0, largest or shear_scale(values))
        known = np.empty(0) if largest else np.abs(values[np.isfinite(values)])
        end = largest or round_up(float(np.percentile(known, 99.0)) if known.size else 0.0)
        return cls(told, shades, 0.0 if quantity in _COLOURS else -end, end)


def shear_scale(*fields: Values) -> float:
    """Where the colours of the maximum shear strain end: just above the 99th percentile of the field with the largest.

    Rounded up to the next multiple of 0.05, and from 0.05 to 0.5. Fields are arrays of any shape, NaN where undefined.

    >>> shear_scale(np.array([0.02, 0.07]), np.array([0.11, np.nan])), shear_scale(np.array([0.9])), shear_scale()
    (0.15, 0.5, 0.05)
    """
    known = [values[np.isfinite(values)] for values in fields]
    most = max((float(np.percentile(values, 99.0)) for values in known if values.size), default=0.0)
    return float(np.clip(np.ceil(20.0 * most - 1e-6) / 20.0, _LEAST_SCALE, _MOST_SCALE))


def scale_told(end: float, *, among: str = "") -> str:
    """Where the colours of the maximum shear strain end, for a caption; ``among`` says of what all maps share them."""
    first, of = "The scale", ""
    if among:
        first = f"All maps of the maximum shear strain in this {among} have one colour scale. It"
        of = " under the load with the largest strain"
    rule = f"99th percentile of the measured strain{of}, rounded up; at most 0.5"
    return f"{first} ends at {end:g} ({rule}). Larger values have the last colour."


def round_up(value: float) -> float:
    """The next number of one digit or so.

    >>> [round_up(v) for v in (0.173, 0.0449, 7.2, 0.0)]
    [0.2, 0.05, 8.0, 1.0]
    """
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(f"{next(s for s in _ENDS if s * power >= value * (1 - 1e-9)) * power:.3g}")


def coloured(
    view: View,
    image: Image | None,
    values: Values,
    scale: Scale,
    *,
    planes: Sequence[Plane] = PLANES,
    outline: LabelMap | None = None,
    bare: bool = False,
) -> Sheet:
    """A scalar in colour over an image, where there is one, in some planes or one; not yet finished.

    ``bare``: without the colours, but with their bar.
    """
    chosen: tuple[Plane, ...] = (planes,) if isinstance(planes, str) else tuple(planes)  # type: ignore[assignment]
    if not chosen or any(plane not in PLANES for plane in chosen):
        raise InputError(f"Planes must be from {', '.join(PLANES)}; got {', '.join(map(str, chosen)) or 'none'}.")
    sheet = Sheet(view, [""], chosen, bar=True)
    colours, norm = colormaps[scale.shades], Normalize(scale.low, scale.high)
    window = (0.0, 1.0) if image is None else window_of(view, image.values)
    for plane, axes in sheet.rows[0].items():
        if image is not None:
            sheet.grey(plane, axes, image.values, window)
        if not bare:
            sheet.colours(plane, axes, values, colours, norm)
        if outline is not None:
            labels = view.cut(outline.labels, plane)
            sheet.outlines(plane, axes, (labels == label for label in outline.names))
    shown = view.shown(values)
    beyond = bool((shown < scale.low).any()), bool((shown > scale.high).any())
    pointed = {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}
    sheet.bar(colours, norm, scale.told, pointed[beyond])
    return sheet


def bone_slices(reference: Image, given: Mask, used: Mask) -> Figure:
    """The unloaded image around the bone. Blue: the mask as given. Orange: where strain may be discontinuous.

    The orange line should follow the outer edge of the bone's dark rim. Where it does not, correct the mask. Both are
    drawn in the tissue only. Slices through the middle of the bone.
    """
    view = View.through(reference.grid, None, given.inside | used.inside)
    sheet = Sheet(view, [""])
    window = window_of(view, reference.values)
    for plane, axes in sheet.rows[0].items():
        sheet.grey(plane, axes, reference.values, window)
        for bone, colour in ((given, "#56D4FF"), (used, "#FFB000")):
            sheet.outlines(plane, axes, [view.cut(bone.inside, plane)], colour)
    return sheet.finished()


def jacobian_slices(view: View, reference: Image, jacobian: Float32Array) -> Figure:
    """Volume ratio det F in colour over the unloaded image: purple shrinks, orange expands, white keeps its volume.

    Red, with the number of voxels: the deformation folds (det F <= 0). Do not trust any result there.
    """
    sheet = coloured(view, reference, jacobian, Scale.of("jacobian", view.shown(jacobian)))
    for plane, axes in sheet.rows[0].items():
        folded = view.cut(jacobian, plane) <= 0.0
        if folded.any():
            red = np.zeros((*folded.shape, 4))
            red[folded] = (1.0, 0.0, 0.0, 1.0)
            sheet.paint(plane, axes, red, interpolation="nearest")
            told = f"folded: {np.count_nonzero(folded)} voxels"
            style = ON_DARK | BOLD | {"color": "#FF8A80", "transform": axes.transAxes}
            axes.text(0.5, 0.08, told, ha="center", **style)
    return sheet.finished()


def volume_reach(jacobian: Values) -> float:
    """How far from 1 the colours of a volume ratio reach: to a tenth, 99 % of it, 0.1 to 0.8."""
    change = np.abs(jacobian[jacobian > 0.0] - 1.0)
    return float(np.clip(np.ceil(np.percentile(change, 99.0) * 10) / 10, 0.1, 0.8)) if change.size else 0.1


def similarity_slices(view: View, rigid: Float32Array, registered: Float32Array) -> Figure:
    """Local correlation of the loaded with the unloaded image; before and after the non-rigid part.

    Yellow: similar. Dark: different, or without structure to compare.
    """
    sheet = Sheet(view, _STAGES, bar=True)
    shades, norm = colormaps["cividis"], Normalize(0.0, 1.0)
    for row, values in zip(sheet.rows, (rigid, registered), strict=True):
        for plane, axes in row.items():
            page = np.ma.masked_invalid(view.cut(values, plane))
            sheet.paint(plane, axes, page, cmap=shades, norm=norm, interpolation="nearest")
    below = any(bool((view.shown(values) < 0.0).any()) for values in (rigid, registered))
    sheet.bar(shades, norm, "local correlation (1: identical), no unit", "min" if below else "neither")
    return sheet.finished()


def deformed_grid(view: View, aligned: Float32Array, displacement_mm: Float32Array, bone: BoolArray | None) -> Figure:
    """Material lines over the loaded image, aligned on the bone (orange).

    Without load the lines are straight and 5 mm apart. The measured displacement moves them; they should follow the
    tissue in the image. Only the two in-plane components are drawn. Lines end where there is no result.
    """
    if displacement_mm.shape[3:] != (3,):
        raise GeometryError(f"A displacement must have three components per voxel; got shape {displacement_mm.shape}.")
    planes: tuple[Plane, ...] = ("sagittal", "coronal")
    sheet = Sheet(view, [""], planes)
    window = window_of(view, aligned)
    for plane, axes in sheet.rows[0].items():
        sheet.grey(plane, axes, aligned, window)
        lines = carried_lines(view, plane, displacement_mm)
        axes.add_collection(LineCollection(lines, colors="#56D4FF", linewidths=1.1), autolim=False)
        if bone is not None:
            sheet.outlines(plane, axes, [view.cut(bone, plane)], "#FFB000")
    return sheet.finished()


def carried_lines(view: View, plane: Plane, displacement_mm: Values) -> list[FloatArray]:
    """Lines of a square grid of 5 mm in a slice, where the displacement u(X) carries them within it.

    Each (n, 2), across and along the page, mm in the frame of `View.extent_mm`; NaN in u (LPS components) cuts them.
    """
    left, right, bottom, top = view.extent_mm(plane)
    low, high = min(bottom, top), max(bottom, top)
    _, across, along = AXES[plane]
    in_plane = view.grid.toward_lps().direction[:, [across, along]]
    u = np.asarray(view.cut(displacement_mm, plane), dtype=np.float64) @ in_plane
    xs, ys = np.arange(left + _LINE_MM / 2, right, _LINE_MM), np.arange(low + _LINE_MM / 2, high, _LINE_MM)
    fine_x, fine_y = np.arange(left, right, 0.5), np.arange(low, high, 0.5)
    straight = [np.column_stack([np.full_like(fine_y, x), fine_y]) for x in xs]
    straight += [np.column_stack([fine_x, np.full_like(fine_x, y)]) for y in ys]
    carried: list[FloatArray] = []
    for line in straight:
        row = (line[:, 1] - top) / (bottom - top) * u.shape[0] - 0.5
        at = np.stack([row, (line[:, 0] - left) / (right - left) * u.shape[1] - 0.5])
        moved = line + np.stack([map_coordinates(u[..., c], at, order=1, cval=np.nan) for c in (0, 1)], axis=-1)
        known = np.isfinite(moved).all(axis=1)
        breaks = np.flatnonzero(np.diff(known.astype(np.int8))) + 1
        carried += [part for part in np.split(moved, breaks) if len(part) > 1 and np.isfinite(part[0]).all()]
    return carried


def strain_volume(
    max_shear: Float32Array, labels: LabelMap, strains: npt.ArrayLike = _WRITTEN
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Strains, and the volume of each region, mL, in which the maximum shear strain exceeds them; exact, without bins.

    A region without any result is left out.
    """
    at, voxel_ml = np.asarray(strains, dtype=np.float64), labels.grid.voxel_volume_mm3 / 1000.0
    values = {name: max_shear[labels.labels == label] for label, name in labels.names.items()}
    return {name: (at, volume_above(of, voxel_ml, at)) for name, of in values.items() if np.isfinite(of).any()}


def shear_curves(max_shear: Float32Array, labels: LabelMap, noise_floor: float | None = None) -> Figure:
    """Volume of each region, mL, in which the maximum shear strain exceeds a value: exact step curves, without bins.

    Both panels show the same curves; the logarithmic axis resolves the small volumes at high strain. The legend gives
    the fraction of a region without a result; the curve of such a region is a lower bound.
    """
    figure, panels = chart(2, page_wide=True)
    look, curves = looks(labels.names.values(), TISSUES), strain_volume(max_shear, labels, _DRAWN)
    for label, name in labels.names.items():
        if name not in curves:
            continue
        (at, above), missing = curves[name], float(np.isnan(max_shear[labels.labels == label]).mean())
        told = name.replace("$", r"\$")  # a dollar would start a formula
        told += "" if missing < 0.0005 else f" ({100 * missing:.1f} % without a result)"
        for axes, shown in zip(panels, (above, np.where(above > 0, above, np.nan)), strict=True):
            axes.step(at, shown, where="post", label=told, **look[name].line)
    panels[1].set_yscale("log")
    panels[1].yaxis.set_major_formatter(FormatStrFormatter("%g"))
    panels[1].yaxis.set_minor_locator(NullLocator())  # their marks took half the time of the figure
    for axes, scale in zip(panels, ("linear", "logarithmic"), strict=True):
        axes.set_xlim(0.0, _HIGHEST_SHEAR)
        label_axes(axes, MAX_SHEAR, "volume above this strain, mL", f"Strain-volume curve, {scale} axis")
        if noise_floor is not None:
            axes.axvspan(0.0, noise_floor, **BAND, label="below the noise floor")
    panels[0].set_ylim(bottom=0.0)
    legend(panels[0])
    return figure
