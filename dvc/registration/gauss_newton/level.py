"""One level of a Gauss-Newton registration: its energy, and steps that lower it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import map_coordinates

from dvc.arrays import BoolArray, FloatArray
from dvc.compiled import njit
from dvc.deformation.interface_spline import Interfaces
from dvc.errors import RegistrationError
from dvc.images.image import Grid, Image
from dvc.registration.gauss_newton.image_term import ImagePair, Normal
from dvc.registration.gauss_newton.roughness import Roughness
from dvc.registration.gauss_newton.solver import by_blocks, conjugate_gradients, dot, with_local_jump
from dvc.registration.gauss_newton.spline_sums import SplineSums
from dvc.registration.gauss_newton.sweeps import Stiffness
from dvc.threads import in_parts

_BLOCKS = 2.5  # blocks between two control points, about
_LONGEST = 0.45  # of the control spacing: a step of less than that cannot fold by itself
_HALVINGS = 4
_SLACK = 1e-3  # the fixed image's gradient is not quite the energy's own: near the end it may rise by as much
_SOLVER = 0.01, 20  # of the conjugate gradients: reduction of the residual, most iterations
_SOLVER_OF_HALF = 0.01, 40  # half of the voxels are fitted in one step, to choose a weight, however large that is
_SOLVER_AT_BONE, _SOLVER_AT_BONE_OF_HALF = (0.1, 20), (0.05, 40)  # where the surface of the bone is the only interface
_SMALLEST = 1e-6
_ON_DIAGONAL = [0, 3, 5]  # xx, yy, zz
_LEAST_RESIDUAL = 0.01  # of the tissue's brightness: no two images agree better, and noise-free ones must not fold
_FLATTEST = 0.1  # det F below this is taken as this in F^-T
_DIVERGED = "Check both images and the masks, or start from the result of a smaller load (chain)."


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the prior."""

    bending: float  # 1/mm
    volume: float  # of the change of volume in soft tissue, 1/mm3
    rigidity: float  # of strain in stiff tissue, 1/mm3
    volume_gradient: float = 0.0  # of the gradient of that change, 1/mm: volume may then change, slowly in space

    @property
    def patience(self) -> int:
        """How many times as many steps to take: where volume may change, each goes less far."""
        return 2 if self.volume_gradient else 1


@dataclass(frozen=True, eq=False)
class State:
    """A displacement and all that a step from it needs, with all voxels (-1) or one half of them (0, 1)."""

    halves: int
    blocks: SplineSums
    coefficients: FloatArray  # (3 splines, mi, mj, mk), mm
    F: FloatArray  # (bi, bj, bk, 3, 3), deformation gradient at the blocks
    cofactor: FloatArray  # (bi, bj, bk, 3, 3), derivative of det F
    J: FloatArray  # (bi, bj, bk), det F
    bent: FloatArray  # (3 splines, mi, mj, mk), gradient of the bending energy
    images: Normal

    @property
    def variance(self) -> float:
        """Mean square of the residual over the voxels that were asked for."""
        return self.images.square / self.images.count

    @cached_property
    def own_blocks(self) -> list[FloatArray]:
        """The images' part of the control points' own blocks, on each grid."""
        return self.blocks.own_blocks(self.images.matrix)


class Level:
    """Two images at one resolution, the roughness on the control points, and the tissue that the prior is about.

    `soft` voxels of the fixed image keep their volume, `stiff` ones (bone, or the skin) resist strain. What nothing
    else holds stays near `rest`, coefficients (3 splines, mi, mj, mk), or at rest. Other parameters as in `ImagePair`.
    """

    def __init__(
        self, images: tuple[Image, Image], inside: BoolArray, soft: BoolArray, stiff: BoolArray, roughness: Roughness,
        rim_mm: float = 0.0, interfaces: Interfaces | None = None, rest: FloatArray | None = None,
    ) -> None:  # fmt: skip
        self.rest = rest
        grid, control = images[0].grid, roughness.control
        block = np.maximum(np.rint(control.spacing_mm / _BLOCKS / grid.spacing_mm), 1).astype(np.int64)
        self.control, self.roughness = control, roughness
        self.pair = ImagePair(*images, inside, control, block, rim_mm, interfaces)
        alone = bool(self.pair.blocks.shift)
        self._solver = _SOLVER_AT_BONE if alone else _SOLVER
        self._solver_of_half = _SOLVER_AT_BONE_OF_HALF if alone else _SOLVER_OF_HALF
        self._tissue = _share_at(control, soft | stiff, grid)
        self._soft, self._stiff = self.pair.share(soft), self.pair.share(stiff)  # mm3 in each block
        self._resists = self._stiff > 0
        self._between = []  # neighbours in soft tissue: the volume that their difference stands for, over its length^2
        self._alone = np.zeros_like(self._soft)  # what a change of volume in one block alone costs by its gradient
        for axis, length in enumerate(block * grid.spacing_mm):
            self._between.append(np.minimum(*_neighbours(self._soft, axis)) / length**2)
            before, after = _neighbours(self._alone, axis)
            before += self._between[-1]
            after += self._between[-1]

    def following(self, coefficients: FloatArray) -> Roughness:
        """`roughness`, with less weight where this displacement of the tissue is curved."""
        return self.roughness.following(coefficients, self._tissue)

    def at(self, coefficients: FloatArray, halves: int = -1) -> State:
        """The state at a displacement; of the voxels all (-1) or one half (0, 1), as in `ImagePair.normal`."""
        F, cofactor, J, pulled = strained(self.pair.blocks.evaluate(coefficients)[1])
        images = self.pair.normal(coefficients, pulled, halves)
        if images.count == 0 or not np.isfinite(images.square) or (halves >= 0 and np.isnan(images.left_out)):
            raise RegistrationError(f"The registration diverged: the two images no longer overlap. {_DIVERGED}")
        bent = self.roughness.product(coefficients)
        if self.rest is not None:
            bent -= self.roughness.held(self.rest)
        return State(halves, self.pair.blocks, coefficients, F, cofactor, J, bent, images)

    def prior(self, state: State, weights: Weights) -> float:
        """The energy of everything but the images."""
        strain = _green_lagrange(state.F[self._resists])
        uneven = weights.volume_gradient * dot(state.J, self._unevenness(state.J)) if weights.volume_gradient else 0.0
        return 0.5 * (
            weights.bending * self._roughness(state)
            + weights.volume * dot(self._soft, (state.J - 1.0) ** 2)
            + weights.rigidity * dot(self._stiff[self._resists], np.einsum("nab,nab->n", strain, strain))
            + uneven
        )

    def _roughness(self, state: State) -> float:
        """Twice the energy of the roughness, with the distance from `rest`."""
        if self.rest is None:
            return dot(state.coefficients, state.bent)
        return dot(state.coefficients, state.bent) + dot(self.rest - state.coefficients, self.roughness.held(self.rest))

    def prior_gradient(self, state: State, weights: Weights) -> FloatArray:
        """Derivative of `prior` by the coefficients."""
        pressure = weights.volume * self._soft * (state.J - 1.0)
        if weights.volume_gradient:
            pressure += weights.volume_gradient * self._unevenness(state.J)
        stress = pressure[..., None, None] * state.cofactor
        F, weight = state.F[self._resists], weights.rigidity * self._stiff[self._resists]
        stress[self._resists] += weight[:, None, None] * (F @ _green_lagrange(F))
        return np.asarray(self.pair.blocks.gathered(stress) + weights.bending * state.bent)

    def step(self, state: State, weights: Weights, variance: float, solver: tuple[float, int]) -> FloatArray:
        """The Gauss-Newton step, by conjugate gradients."""
        volume, shear = weights.volume * self._soft, weights.rigidity * self._stiff
        stiffness: Stiffness = (state.images.matrix / variance, state.cofactor, volume, shear)
        force = state.images.force / variance - self.prior_gradient(state, weights)
        blocks = self.pair.blocks

        def product(c: FloatArray) -> FloatArray:
            out = blocks.product(c, stiffness) + weights.bending * self.roughness.product(c)
            if weights.volume_gradient:
                swelling = np.einsum("...ab,...ab->...", state.cofactor, blocks.evaluate(c)[1])
                pressure = weights.volume_gradient * self._unevenness(swelling)
                out += blocks.gathered(pressure[..., None, None] * state.cofactor)
            return np.asarray(out)

        of_images, of_prior = state.own_blocks, self._prior_blocks(weights)
        diagonals = [own / variance + held for own, held in zip(of_images, of_prior, strict=True)]
        for own in diagonals:
            for block in own.reshape(-1, 6, *own.shape[1:]):
                block[_ON_DIAGONAL] += _SMALLEST * block[_ON_DIAGONAL].max(axis=(1, 2, 3), keepdims=True)
        preconditioned = by_blocks(diagonals)
        if blocks.shift:
            preconditioned = with_local_jump(preconditioned, blocks.shift)
        return conjugate_gradients(product, force, preconditioned, *solver)

    def _prior_blocks(self, weights: Weights) -> list[FloatArray]:
        """The prior's part of the control points' own blocks, on each grid."""
        blocks = [weights.volume * own for own in self._of_volume]
        if weights.rigidity and self._resists.any():
            blocks = [block + weights.rigidity * own for block, own in zip(blocks, self._of_shear, strict=True)]
        if weights.volume_gradient:
            blocks = [b + weights.volume_gradient * own for b, own in zip(blocks, self._of_gradient, strict=True)]
        for grid, block in enumerate(blocks):
            own = self.roughness.diagonals(grid)
            if self.pair.blocks.shift:
                own[1] += self.pair.blocks.shift**2 * own[0]
            for spline, rough in enumerate(own):
                block[6 * spline : 6 * spline + 6][_ON_DIAGONAL] += weights.bending * rough
        return blocks

    # What does not change from step to step: blocks on each grid for weights of 1.
    @cached_property
    def _of_volume(self) -> list[FloatArray]:
        return self.pair.blocks.own_blocks(volume=self._soft)

    @cached_property
    def _of_shear(self) -> list[FloatArray]:
        return self.pair.blocks.own_blocks(shear=self._stiff)

    @cached_property
    def _of_gradient(self) -> list[FloatArray]:
        return self.pair.blocks.own_blocks(volume=self._alone)

    def descend(self, coefficients: FloatArray, weights: Weights, *, steps: int, stop_mm: float) -> State:
        """Take at most so many `steps`; end once one moves soft tissue by less than `stop_mm` (rms), or none helps."""
        state = self.at(coefficients)  # which nothing else holds: its memory goes to the states that follow
        for _ in range(steps):
            state, moved_mm = self.lower(state, weights)
            if not moved_mm or moved_mm < stop_mm:
                break
        return state

    def lower(self, state: State, weights: Weights) -> tuple[State, float]:
        """The state after one step, and how far it moved soft tissue (rms, mm): 0 where no step lowers the energy."""
        variance, count = max(state.variance, _LEAST_RESIDUAL**2), state.images.count

        def energy(at: State) -> float:
            # with the mean over voxels, so that tissue that leaves the picture does not lower it
            return 0.5 * count * at.variance / variance + self.prior(at, weights)

        before = energy(state)
        step = self.step(state, weights, variance, self._solver if state.halves < 0 else self._solver_of_half)
        if not np.isfinite(step).all():
            raise RegistrationError(f"The registration diverged: a step is not finite. {_DIVERGED}")
        moved = self.pair.blocks.evaluate(step)[0]
        # Air, and tissue that no image shows, may go where it likes; tissue not where the energy then rises.
        tissue = (self._soft > 0) | self._resists
        seen, everywhere = (self._share(moved[w]) for w in (tissue & state.images.shown, tissue))
        for share in (*(seen * 0.5**n for n in range(_HALVINGS)), min(everywhere, seen * 0.5**_HALVINGS)):
            trial = self.at(state.coefficients + share * step, state.halves)
            if energy(trial) <= before + _SLACK * abs(before):
                square = np.einsum("...a,...a->...", moved, moved)
                return trial, share * float(np.sqrt(dot(self._soft, square) / max(self._soft.sum(), _SMALLEST)))
            del trial  # its memory goes to the next
        return state, 0.0

    def _share(self, moved: FloatArray) -> float:
        """The share of a step, 1 at the most, by which no place moves so far that the step folds it by itself."""
        longest = float((np.abs(moved) / self.control.spacing_mm).max(initial=0.0))
        return min(1.0, _LONGEST / max(longest, _SMALLEST))

    def volume_asked(self, coefficients: FloatArray, weights: Weights, held_mm4: float) -> float:
        """The change of volume |J - 1| that a hundredth of the soft tissue exceeds once only its gradient is held.

        One step from the result that keeps volume. The gradient's weight is `held_mm4` times how sharply the images see
        a displacement, the median over soft tissue of g^2 / s^2 along an axis, 1/mm5. Held so, a change over 2 cm or
        more costs little, and noise, or detail that the spline cannot follow without it, moves it by a hundredth.
        """
        state, soft = self.at(coefficients), self._soft > 0.99 * self._soft.max()
        seen = float(np.median(state.images.matrix[soft][:, [0, 3, 5]].mean(axis=1)))
        sharpness = seen / max(state.variance, _LEAST_RESIDUAL**2) / float(self._soft.max())
        looking = replace(weights, volume=0.0, volume_gradient=held_mm4 * sharpness)
        freed, _ = self.lower(state, looking)
        return float(np.percentile(np.abs(freed.J - 1.0)[soft], 99.0))

    def _unevenness(self, J: FloatArray) -> FloatArray:
        """Derivative by J of half the integral of |grad J|^2 over soft tissue, by differences, mm."""
        out = np.zeros_like(J)
        for axis, between in enumerate(self._between):
            (low, high), (before, after) = _neighbours(J, axis), _neighbours(out, axis)
            flow = between * (high - low)
            before -= flow
            after += flow
        return out


def _share_at(control: Grid, mask: BoolArray, grid: Grid) -> FloatArray:
    """A mask at control points, 0 to 1, interpolated: the same in any frame, where nearest voxels may be two."""
    at = np.moveaxis(grid.indices_of(control.points()), -1, 0)
    return np.asarray(map_coordinates(mask.astype(np.float64), at, order=1, mode="grid-constant"))


def _neighbours(field: FloatArray, axis: int) -> tuple[FloatArray, FloatArray]:
    """Views on the values before and after each border between neighbours along an axis."""
    along = np.moveaxis(field, axis, 0)
    return np.moveaxis(along[:-1], 0, axis), np.moveaxis(along[1:], 0, axis)


def strained(H: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """F = I + H of displacement gradients H (..., 3, 3), no unit; its cofactors, det F (...), and F^-T.

    Cofactors, cof F = det F F^-T, are the derivative of det F. For F^-T, det F is at least 0.1.
    """
    F, cofactor, J, pulled = np.empty_like(H), np.empty_like(H), np.empty(H.shape[:-2]), np.empty_like(H)
    flat = tuple(each.reshape(-1, 3, 3) for each in (H, F, cofactor, pulled))
    in_parts(_strained, J.size, *flat, J.reshape(-1))
    return F, cofactor, J, pulled


@njit(nogil=True, cache=True)
def _strained(
    start: int, stop: int, H: FloatArray, F: FloatArray, cofactor: FloatArray, pulled: FloatArray, J: FloatArray
) -> None:
    for n in range(start, stop):
        for a in range(3):
            for b in range(3):
                F[n, a, b] = H[n, a, b] + (a == b)
        for a, c, d in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            cofactor[n, a, 0] = F[n, c, 1] * F[n, d, 2] - F[n, c, 2] * F[n, d, 1]
            cofactor[n, a, 1] = F[n, c, 2] * F[n, d, 0] - F[n, c, 0] * F[n, d, 2]
            cofactor[n, a, 2] = F[n, c, 0] * F[n, d, 1] - F[n, c, 1] * F[n, d, 0]
        J[n] = F[n, 0, 0] * cofactor[n, 0, 0] + F[n, 0, 1] * cofactor[n, 0, 1] + F[n, 0, 2] * cofactor[n, 0, 2]
        least = max(J[n], _FLATTEST)
        for a in range(3):
            for b in range(3):
                pulled[n, a, b] = cofactor[n, a, b] / least


def _green_lagrange(F: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (np.swapaxes(F, -1, -2) @ F - np.eye(3)))
