"""Strain from the displacement gradient: one function of H, whoever the deformation came from.

Configurations: E (Green-Lagrange) and everything derived from it here live in the reference configuration;
its axes are LPS, its numbers have no unit.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dvc.arrays import BoolArray, FloatArray, frozen
from dvc.compiled import njit
from dvc.errors import InputError
from dvc.threads import in_parts

_ORTHONORMAL = 1e-9
_PARALLEL_SINE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class StrainField:
    """Green-Lagrange strain at n points: ``E = (F^T F - I) / 2`` with ``F = I + H``, ``H = du/dX``.

    Made by `from_gradient`.

    Attributes
    ----------
    green_lagrange : (n, 3, 3)
        E, reference configuration, LPS components; NaN where H is not known.
    principal : (n, 3)
        Eigenvalues of E, ``E_1 >= E_2 >= E_3``.
    max_shear : (n,)
        ``(E_1 - E_3) / 2``.
    jacobian : (n,)
        ``det F``, volume now over volume before; not positive where the deformation folds.
    valid : (n,) bool
        Where H is finite; False where everything else is NaN.

    Examples
    --------
    Simple shear ``x = X + gamma Y`` with gamma = 0.3:

    >>> H = np.zeros((1, 3, 3))
    >>> H[0, 0, 1] = 0.3
    >>> strain = StrainField.from_gradient(H)
    >>> strain.green_lagrange[0, :2, :2].round(12).tolist()
    [[0.0, 0.15], [0.15, 0.045]]
    >>> bool(np.isclose(strain.max_shear[0], 0.15 * np.sqrt(1 + 0.15**2))), float(strain.jacobian[0])
    (True, 1.0)
    """

    green_lagrange: FloatArray
    principal: FloatArray
    max_shear: FloatArray
    jacobian: FloatArray
    valid: BoolArray

    @classmethod
    def from_gradient(cls, gradient: npt.ArrayLike) -> Self:
        """Compute the strain of displacement gradients.

        Parameters
        ----------
        gradient : (n, 3, 3)
            ``H[i, j] = du_i/dX_j``; NaN where not defined.

        Raises
        ------
        InputError
            If the shape is another.

        Notes
        -----
        ``E = (H + H^T + H^T H) / 2`` and ``det F = 1 + tr H + II(H) + det H``, so that small strains do not
        drown in ``F^T F - I``.
        """
        H = np.ascontiguousarray(gradient, dtype=np.float64)
        if H.ndim != 3 or H.shape[1:] != (3, 3):
            raise InputError(f"Displacement gradients must have shape (n, 3, 3); got {H.shape}.")
        count = len(H)
        strain, principal, shear, jacobian = (np.empty((count, *shape)) for shape in ((3, 3), (3,), (), ()))
        valid = np.empty(count, dtype=np.bool_)
        in_parts(_strain, len(H), H, strain, principal, shear, jacobian, valid)
        for array in (strain, principal, shear, jacobian, valid):
            array.flags.writeable = False
        return cls(strain, principal, shear, jacobian, valid)

    def __len__(self) -> int:
        return len(self.valid)

    def principal_directions(self) -> FloatArray:
        """Compute unit eigenvectors of E, (n, 3, 3), as columns in the order of `principal`; right-handed.

        The largest component of the first two is positive. Where eigenvalues coincide the directions are an
        arbitrary choice among the possible ones. NaN where not valid.
        """
        directions = np.full(self.green_lagrange.shape, np.nan)
        vectors = np.linalg.eigh(self.green_lagrange[self.valid])[1][:, :, ::-1].copy()
        largest = np.abs(vectors).argmax(axis=1)[:, None, :]
        vectors *= np.where(np.take_along_axis(vectors, largest, axis=1) < 0, -1.0, 1.0)
        vectors[:, :, 2] = np.cross(vectors[:, :, 0], vectors[:, :, 1])
        directions[self.valid] = vectors
        return directions

    def volumetric(self) -> FloatArray:
        """Change of volume over volume before, ``det F - 1``, (n,)."""
        return self.jacobian - 1.0

    def octahedral_shear(self) -> FloatArray:
        """Shear on the octahedral plane, ``2/3 sqrt((E_1-E_2)^2 + (E_2-E_3)^2 + (E_3-E_1)^2)``, (n,)."""
        first, second, third = self.principal.T
        return np.asarray(2.0 / 3.0 * np.sqrt((first - second) ** 2 + (second - third) ** 2 + (third - first) ** 2))

    def logarithmic(self) -> FloatArray:
        """Hencky's strain ``ln U = ln(I + 2 E) / 2``, (n, 3, 3), reference configuration.

        NaN where not valid, and where det F is zero.
        """
        logarithm = np.full(self.green_lagrange.shape, np.nan)
        values, vectors = np.linalg.eigh(self.green_lagrange[self.valid])
        stretch = 0.5 * np.log1p(2.0 * np.where(values > -0.5, values, np.nan))
        logarithm[self.valid] = (vectors * stretch[:, None, :]) @ vectors.transpose(0, 2, 1)
        return logarithm

    def components_in(self, axes: npt.ArrayLike) -> FloatArray:
        """E in other axes, (n, 3, 3): ``A^T E A``.

        Parameters
        ----------
        axes : (3, 3)
            The new axes as columns, orthonormal, LPS; see `plate_axes`.

        Raises
        ------
        InputError
            If the columns are not perpendicular unit vectors.
        """
        A = np.asarray(axes, dtype=np.float64)
        if A.shape != (3, 3) or not np.abs(A.T @ A - np.eye(3)).max() < _ORTHONORMAL:
            raise InputError(f"Axes must be perpendicular unit vectors, columns of a 3 x 3 matrix; got {A.tolist()}.")
        return np.asarray(A.T @ self.green_lagrange @ A)


def plate_axes(normal: npt.ArrayLike, shear: npt.ArrayLike) -> FloatArray:
    """Make the axes of a loading plate, (3, 3) LPS: columns normal, direction of shear, their cross product.

    Parameters
    ----------
    normal : (3,)
        Direction of the normal force; any length.
    shear : (3,)
        Direction of the shear force; any length. What it has along the normal is taken out.

    Raises
    ------
    InputError
        If a direction is zero or not finite, or the two are parallel.

    Examples
    --------
    >>> plate_axes([0, 0, 2], [0, 1, 5]).T.tolist()
    [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
    """
    first = _unit(normal, "normal")
    second = _unit(shear, "shear direction")
    second = second - (second @ first) * first
    if np.linalg.norm(second) < _PARALLEL_SINE:
        raise InputError("The plate normal and the shear direction are parallel; they must differ.")
    second = second / np.linalg.norm(second)
    second = second - (second @ first) * first  # once more: the first time loses digits where the two are close
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1) + 0.0


def _unit(direction: npt.ArrayLike, name: str) -> FloatArray:
    vector = frozen(direction, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise InputError(f"The plate's {name} must be three finite numbers, not all zero; got {vector.tolist()}.")
    vector = vector / np.abs(vector).max()
    return np.asarray(vector / np.linalg.norm(vector))


def principal_values(tensors: npt.ArrayLike) -> FloatArray:
    """Eigenvalues of symmetric tensors, (n, 3) in descending order, in closed form; NaN where one is not finite.

    Parameters
    ----------
    tensors : (n, 3, 3)
        Symmetric; of each pair off the diagonal the mean is taken.

    Raises
    ------
    InputError
        If the shape is another.

    Notes
    -----
    With the deviator a, ``J2 = a:a / 2``, ``J3 = det a``, and k = 0, 1, 2:
    ``l_k = tr/3 + 2 sqrt(J2/3) cos(angle - 2 pi k / 3)``, ``tan(3 angle) = sqrt(D) / (sqrt(27) J3)`` [1]_.
    The usual ``D = 4 J2^3 - 27 J3^2``, or an arc cosine in its place, loses half of the digits where two
    eigenvalues are close. D, the product of the squared differences of the eigenvalues, is here three times
    the Gram determinant of a and b = dev(a a), since ``|a|^2 = 2 J2``, ``|b|^2 = 2/3 J2^2``, ``a:b = 3 J3``;
    and that is a sum of squares, the 2 x 2 minors of the two as vectors of five. So the error stays within a
    few units in the last place of the tensor's norm.

    References
    ----------
    .. [1] O. K. Smith, "Eigenvalues of a symmetric 3 x 3 matrix", Commun. ACM 4(4), 168, 1961.
       doi:10.1145/355578.366316

    Examples
    --------
    >>> principal_values([np.diag([1.0, 3.0, 1.0])]).round(12).tolist()
    [[3.0, 1.0, 1.0]]
    """
    array = np.ascontiguousarray(tensors, dtype=np.float64)
    if array.ndim != 3 or array.shape[1:] != (3, 3):
        raise InputError(f"Tensors must have shape (n, 3, 3); got {array.shape}.")
    values = np.empty((len(array), 3))
    in_parts(_principal_of, len(array), array, values)
    return values


@njit(cache=True)
def _principal(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> tuple[float, float, float]:
    for component in (xx, yy, zz, xy, xz, yz):
        if not np.isfinite(component):
            return np.nan, np.nan, np.nan
    scale = max(abs(xx), abs(yy), abs(zz), abs(xy), abs(xz), abs(yz))
    if scale == 0.0:
        return 0.0, 0.0, 0.0
    xx, yy, zz, xy, xz, yz = xx / scale, yy / scale, zz / scale, xy / scale, xz / scale, yz / scale
    mean = (xx + yy + zz) / 3.0
    # The deviator from differences, which are exact where the diagonal is nearly constant.
    a, b, c = ((xx - yy) + (xx - zz)) / 3.0, ((yy - xx) + (yy - zz)) / 3.0, ((zz - xx) + (zz - yy)) / 3.0
    size = max(abs(a), abs(b), abs(c), abs(xy), abs(xz), abs(yz))
    if size == 0.0:
        return mean * scale, mean * scale, mean * scale
    a, b, c, d, e, f = a / size, b / size, c / size, xy / size, xz / size, yz / size
    j2 = 0.5 * (a * a + b * b + c * c) + d * d + e * e + f * f
    j3 = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    # a and a a as vectors of five in an orthonormal basis of the traceless symmetric tensors.
    u = ((a - b) / np.sqrt(2.0), (2.0 * c - a - b) / np.sqrt(6.0), np.sqrt(2.0) * d, np.sqrt(2.0) * e, np.sqrt(2.0) * f)
    aa, bb, cc = a * a + d * d + e * e, d * d + b * b + f * f, e * e + f * f + c * c
    dd, ee, ff = a * d + d * b + e * f, a * e + d * f + e * c, d * e + b * f + f * c
    v = (
        (aa - bb) / np.sqrt(2.0), (2.0 * cc - aa - bb) / np.sqrt(6.0), np.sqrt(2.0) * dd, np.sqrt(2.0) * ee,
        np.sqrt(2.0) * ff,
    )  # fmt: skip
    gram = 0.0
    for i in range(4):
        for j in range(i + 1, 5):
            minor = u[i] * v[j] - u[j] * v[i]
            gram += minor * minor
    angle = np.arctan2(np.sqrt(3.0 * gram), np.sqrt(27.0) * j3) / 3.0
    radius = 2.0 * np.sqrt(j2 / 3.0) * size
    cosine, sine = np.cos(angle), np.sqrt(3.0) * np.sin(angle)
    first = mean + radius * cosine
    second = mean + 0.5 * radius * (sine - cosine)
    third = mean - 0.5 * radius * (sine + cosine)
    return max(first, second) * scale, min(first, second) * scale, third * scale


@njit(nogil=True, cache=True)
def _principal_of(start: int, stop: int, tensors: FloatArray, values: FloatArray) -> None:
    for n in range(start, stop):
        t = tensors[n]
        values[n, 0], values[n, 1], values[n, 2] = _principal(
            t[0, 0], t[1, 1], t[2, 2],
            0.5 * t[0, 1] + 0.5 * t[1, 0], 0.5 * t[0, 2] + 0.5 * t[2, 0], 0.5 * t[1, 2] + 0.5 * t[2, 1],
        )  # fmt: skip


@njit(nogil=True, cache=True)
def _strain(
    start: int, stop: int, gradient: FloatArray, strain: FloatArray, principal: FloatArray, shear: FloatArray,
    jacobian: FloatArray, valid: BoolArray,
) -> None:  # fmt: skip
    for n in range(start, stop):
        H, E = gradient[n], strain[n]
        known = True
        for i in range(3):
            for j in range(3):
                known = known and np.isfinite(H[i, j])
        valid[n] = known
        if not known:
            strain[n], principal[n] = np.nan, np.nan
            shear[n], jacobian[n] = np.nan, np.nan
            continue
        for i in range(3):
            for j in range(i, 3):
                product = H[0, i] * H[0, j] + H[1, i] * H[1, j] + H[2, i] * H[2, j]
                E[i, j] = 0.5 * (H[i, j] + H[j, i] + product)
                E[j, i] = E[i, j]
        first, second, third = _principal(E[0, 0], E[1, 1], E[2, 2], E[0, 1], E[0, 2], E[1, 2])
        principal[n, 0], principal[n, 1], principal[n, 2] = first, second, third
        shear[n] = 0.5 * (first - third)
        minors = (
            (H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0])
            + (H[0, 0] * H[2, 2] - H[0, 2] * H[2, 0])
            + (H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1])
        )
        determinant = (
            H[0, 0] * (H[1, 1] * H[2, 2] - H[1, 2] * H[2, 1])
            - H[0, 1] * (H[1, 0] * H[2, 2] - H[1, 2] * H[2, 0])
            + H[0, 2] * (H[1, 0] * H[2, 1] - H[1, 1] * H[2, 0])
        )
        jacobian[n] = 1.0 + ((H[0, 0] + H[1, 1] + H[2, 2]) + minors + determinant)
