"""A measurement at a glance: a figure of any of its quantities, and what a notebook shows of it."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dvc.arrays import Float32Array
from dvc.deformation.strain_maps import TENSOR_COMPONENTS, StrainMaps
from dvc.errors import InputError
from dvc.images.image import Image, LabelMap
from dvc.report import figures
from dvc.report.figures import Scale
from dvc.report.planes import PLANES, Plane, View

_RISING = {
    "max_shear": (figures.MAX_SHEAR, "viridis"),
    "sigma": (figures.SIGMA, "cividis"),
    "displacement_mm": ("length of the displacement relative to the bone, mm", "viridis"),
}
_STEPS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
_SHOWN_PERCENT = 99.0


def values_of(quantity: str, maps: StrainMaps, sigma: Float32Array | None) -> Float32Array:
    """A scalar (ni, nj, nk) by its name, NaN where not defined; InputError for another name, or an unknown sigma."""
    if quantity == "sigma":
        if sigma is None:
            raise InputError("sigma: the error of this measurement is not known; its `error_bars` tell why.")
        return sigma
    if quantity in TENSOR_COMPONENTS:
        return maps.green_lagrange[..., TENSOR_COMPONENTS.index(quantity)]
    known = maps.by_quantity
    if quantity not in known:
        raise InputError(f"No quantity '{quantity}'; there are {', '.join((*known, 'sigma', *TENSOR_COMPONENTS))}.")
    return known[quantity]


def figure(
    view: View,
    image: Image | None,
    quantity: str,
    values: Float32Array,
    outline: LabelMap | None,
    planes: Sequence[Plane],
    largest: float | None,
) -> Figure:
    """Draw a scalar in colour over an image, where there is one, with the borders of labels, if any."""
    chosen: tuple[Plane, ...] = (planes,) if isinstance(planes, str) else tuple(planes)  # type: ignore[assignment]
    if not chosen or any(plane not in PLANES for plane in chosen):
        raise InputError(f"Planes are among {', '.join(PLANES)}; got {', '.join(map(str, chosen)) or 'none'}.")
    if largest is not None and not largest > 0.0:
        raise InputError(f"The end of the colours must be above zero; got {largest}.")
    scale = _scale(quantity, view.shown(values), largest)
    return figures.coloured(view, image, values, scale, planes=chosen, outline=outline).finished()


def _scale(quantity: str, values: Float32Array, largest: float | None) -> Scale:
    """Colours that 99 % of the values shown lie within, ending at a round number."""
    if quantity == "jacobian":
        reach = largest or figures.volume_reach(values)
        return Scale(figures.VOLUME_RATIO, "PuOr_r", 1.0 - reach, 1.0 + reach)
    known = np.abs(values[np.isfinite(values)])
    end = largest or _round_up(float(np.percentile(known, _SHOWN_PERCENT)) if known.size else 0.0)
    if quantity in _RISING:
        return Scale(*_RISING[quantity], 0.0, end)
    return Scale(f"Green-Lagrange strain, component {quantity} in LPS, no unit", "PuOr_r", -end, end)


def _round_up(value: float) -> float:
    """The next number of one digit or so.

    >>> [_round_up(v) for v in (0.173, 0.0449, 7.2, 0.0)]
    [0.2, 0.05, 8.0, 1.0]
    """
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(f"{next(s for s in _STEPS if s * power >= value * (1 - 1e-9)) * power:.3g}")
