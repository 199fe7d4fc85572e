"""Contact of tissue with a rigid plate: bonded (taped) from first contact on, or sliding without friction.

The rotation of the plate adds three unknowns to the sparse system. Nodes on a plate that rotates by a small vector t
about its pivot c move by t x r, r = x - c. With f their internal forces, the moment is sum r x f. In addition to
w_k . K w_l (w_k = e_k x r, K the tangent), the second variation of the energy contains the term of the curved path

    sum  (r f^T + f r^T) / 2 - (r . f) I,

which is symmetric. The system [K B; B^T C] [x; t] = [right; moment] is solved by elimination of x, so that K, its
pattern and its factorisation are those of a plate that does not rotate.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from dvc import plate_axes
from dvc.arrays import BoolArray, FloatArray, IntArray, frozen
from dvc.errors import InputError
from fe.assembly import Assembler
from fe.linear import SingularError, Solver

_BEYOND_MM = 0.5
_SAME_MM = 1e-6  # nodes whose heights differ by less touch together, independent of rounding
_LEAST_ARM_MM = 1e-3
_UNITS = 1e3  # between mm and micrometres
_ACCURACY = 1e-3  # of the linear solutions for a rotation


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """A rigid, flat plate, large enough for the whole surface.

    Parameters
    ----------
    normal : (3,)
        Outward normal, from the tissue to the plate, LPS; the normal force on the tissue is opposite.
    shear : (3,)
        Direction of the shear force on the tissue, LPS; its component along the normal is removed.
    gap_mm : float
        Initial distance between the plate and the skin, mm.
    taped : bool
        Whether a node that has touched the plate sticks to it; otherwise it slides without friction and may separate.
    turns : bool
        Whether the plate rotates freely about its pivot, in all three axes, once it presses; otherwise it stays
        parallel.
    pivot_mm : (3,), optional
        Point whose projection onto the plate's face is the pivot at the start, LPS; by default the point of first
        contact. The pivot moves with the plate, and moments are given about it.

    Attributes
    ----------
    axes : (3, 3)
        Columns are the plate's axes at the start, LPS: the directions of the normal force on the tissue, of shear, and
        their cross product.

    Raises
    ------
    InputError
        If a direction is not three finite numbers or is zero, or the two are parallel; if the gap is negative or the
        pivot is not a point; or if a plate without tape is to rotate.
    """

    normal: npt.ArrayLike
    shear: npt.ArrayLike
    gap_mm: float = 0.0
    taped: bool = True
    turns: bool = False
    pivot_mm: npt.ArrayLike | None = None
    axes: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gap_mm) and self.gap_mm >= 0.0):
            raise InputError(f"The gap between plate and tissue must be 0 mm or more; got {self.gap_mm}.")
        if self.turns and not self.taped:
            raise InputError(
                "A freely rotating plate (turns) needs taped skin: without friction the plate would slip off. Set "
                "taped to True, or turns to False."
            )
        if self.pivot_mm is not None:
            pivot = np.asarray(self.pivot_mm, dtype=np.float64)
            if pivot.shape != (3,) or not np.isfinite(pivot).all():
                raise InputError(f"The plate's pivot needs three finite coordinates in mm; got {self.pivot_mm}.")
        object.__setattr__(self, "axes", plate_axes(-frozen(self.normal, np.float64), self.shear))

    def check_gap(self, body_mm: float) -> None:
        """InputError if the plate begins further from the skin than the body is long, which is a wrong unit."""
        if self.gap_mm > body_mm:
            unit = " Is it in micrometres?" if self.gap_mm <= _UNITS * body_mm else ""
            raise InputError(
                f"The gap between plate and skin, gap_mm (--gap-mm), is {self.gap_mm:g} mm, larger than the body "
                f"({body_mm:.3g} mm). Gaps are in mm.{unit}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class ContactStatus:
    """The nodes in contact with the plate, their positions on it, and its rotation."""

    nodes: BoolArray  # (s,) of those that may touch
    places_mm: FloatArray  # (s, 3) from the pivot, along axes that rotate with the plate; NaN without contact
    rotation: FloatArray  # (3, 3) of those axes relative to the plate's axes at the start
    turns: bool  # whether the plate rotates freely now


class Contact:
    """The nodes on the plate, in the plate's axes at the start (the first is that of the normal force).

    ``nodes_mm`` (n, 3) are the reference positions of all nodes, ``surface`` (s,) those that may touch. InputError if
    other tissue is closer to the plate, because the plate then comes from the wrong side.
    """

    def __init__(self, plate: Plate, nodes_mm: FloatArray, surface: IntArray) -> None:
        self.plate = plate
        self.nodes = surface
        self._start = nodes_mm[surface]
        face_mm = float(self._start[:, 0].min())
        self._first = self._start[:, 0] <= face_mm + _SAME_MM
        over = self._start[self._first].mean(axis=0)
        if plate.pivot_mm is not None:
            over = np.asarray(plate.pivot_mm, dtype=np.float64) @ plate.axes
        self._pivot = np.array([face_mm, *over[1:]])
        nowhere = np.full((len(surface), 3), np.nan)
        self.status = ContactStatus(np.zeros(len(surface), dtype=bool), nowhere, np.eye(3), False)
        self._before = np.zeros_like(self._start)
        nearest = float(nodes_mm[:, 0].min())
        if nearest < face_mm - _BEYOND_MM:
            raise InputError(
                f"The plate would pass through {face_mm - nearest:.1f} mm of other tissue before it touches the skin. "
                "Its normal must point away from the tissue, on the side that is pressed; check its direction."
            )

    @property
    def held(self) -> IntArray:
        """Nodes on the plate."""
        return self.nodes[self.status.nodes]

    @property
    def followers(self) -> dict[int, IntArray]:
        """Unknowns that follow each of the three displacements of the plate."""
        return {axis: 3 * self.held + axis for axis in range(3 if self.plate.taped else 1)}

    def touch_first(self, state: FloatArray) -> None:
        """Move the plate to the surface node, or nodes, that it touches first."""
        places = np.where(self._first[:, None], (self._start - self._pivot) * [0.0, 1.0, 1.0], np.nan)
        self.status = replace(self.status, nodes=self._first, places_mm=places)
        state[3 * self.held] = self._pivot[0] - self._start[self._first, 0]

    def begin(self, state: FloatArray) -> None:
        """Store an equilibrium state as the start of the next increment."""
        self._before = self._seen_from_plate(state)

    def centre_mm(self, state: FloatArray) -> FloatArray:
        """Position of the pivot, (3,) mm."""
        status = self.status
        centres = self._positions(state)[status.nodes] - status.places_mm[status.nodes] @ status.rotation.T
        centre = centres.mean(axis=0)
        if not self.plate.taped:
            centre[1:] = self._pivot[1:]
        return np.asarray(centre)

    def displacement_mm(self, state: FloatArray) -> FloatArray:
        """Displacement of the pivot from the plate's start, (3,) mm."""
        return np.asarray(self.centre_mm(state) - self._pivot + [self.plate.gap_mm, 0.0, 0.0])

    def arms_mm(self, state: FloatArray) -> FloatArray:
        """Vectors from the pivot to each node on the plate (k, 3), mm."""
        return self._positions(state)[self.status.nodes] - self.centre_mm(state)

    def force_n(self, forces: FloatArray) -> FloatArray:
        """Force of the plate on the tissue (3,) N, from the internal forces of all unknowns."""
        return np.array([forces[self.followers.get(axis, np.empty(0, dtype=int))].sum() for axis in range(3)])

    def moment_nmm(self, state: FloatArray, forces: FloatArray) -> FloatArray:
        """Moment of the plate on the tissue about the pivot (3,) N mm."""
        return np.asarray(np.cross(self.arms_mm(state), forces[_unknowns(self.held)]).sum(axis=0))

    def update(self, state: FloatArray, forces: FloatArray) -> bool:
        """Add nodes that have passed the plate and, without tape, release those that it would pull; whether any did.

        ``state`` is changed in place. Nodes that touch are moved onto the plate's face: without tape along its normal;
        with tape to where they crossed the face on a straight line from the previous state, as seen from the plate.
        ``forces`` (unknowns,) are internal, N.
        """
        status, now, before = self.status, self._seen_from_plate(state), self._before
        new = (now[:, 0] <= 0.0) & ~status.nodes
        pulled = np.zeros_like(new)
        place = now.copy()
        if self.plate.taped:
            closed = np.maximum(before[:, 0] - now[:, 0], 1e-12)
            place = before + np.clip(before[:, 0] / closed, 0.0, 1.0)[:, None] * (now - before)
        else:
            pulled = status.nodes & (forces[3 * self.nodes] < 0.0)
        place[:, 0] = 0.0
        if not (new.any() or pulled.any()):
            return False
        put = self.centre_mm(state) + place[new] @ status.rotation.T
        state[_unknowns(self.nodes[new])] = put - self._start[new]
        places = np.where(new[:, None], place, status.places_mm)
        places[pulled] = np.nan
        self.status = replace(status, nodes=(status.nodes & ~pulled) | new, places_mm=places)
        return True

    def _positions(self, state: FloatArray) -> FloatArray:
        return self._start + state[_unknowns(self.nodes)]

    def _seen_from_plate(self, state: FloatArray) -> FloatArray:
        """Positions (s, 3) from the pivot, along axes that rotate with the plate; the first is < 0 past its face."""
        return np.asarray((self._positions(state) - self.centre_mm(state)) @ self.status.rotation)


def _unknowns(nodes: IntArray) -> IntArray:
    return np.asarray(3 * nodes[:, None] + np.arange(3))


class Parallel:
    """A plate that stays parallel; it has no rotational unknowns."""

    def missing_n(self, state: FloatArray, forces: FloatArray) -> float:
        """Residual moment, N; zero, because a parallel plate carries any moment."""
        return 0.0

    def solved(
        self, state: FloatArray, forces: FloatArray, data: FloatArray, level: FloatArray, held: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Change of every equation, equal to ``level``, and a zero rotation (3,)."""
        return level, np.zeros(3)

    def ahead(self, state: FloatArray, change: FloatArray, turn: FloatArray) -> FloatArray:
        """The state after a change of all unknowns."""
        return state + change


class Turning(Parallel):
    """A plate that rotates until its moment about the pivot is ``moment_nmm`` (3,); it rotates ``contact`` in place."""

    def __init__(self, contact: Contact, assembler: Assembler, solver: Solver, moment_nmm: FloatArray) -> None:
        self._contact, self._assembler, self._solver = contact, assembler, solver
        self._moment = moment_nmm
        self._rotation = contact.status.rotation
        self._arms, self._on_plate = np.empty((0, 3)), np.empty((0, 3), dtype=int)

    def missing_n(self, state: FloatArray, forces: FloatArray) -> float:
        """Residual moment divided by the root mean square lever arm of the nodes on the plate, N."""
        arm = float(np.sqrt((self._contact.arms_mm(state) ** 2).sum(axis=1).mean()))
        missing = self._moment - self._contact.moment_nmm(state, forces)
        return float(np.linalg.norm(missing)) / max(arm, _LEAST_ARM_MM)

    def solved(
        self, state: FloatArray, forces: FloatArray, data: FloatArray, level: FloatArray, held: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Change of every equation and the rotation (3,); ``level`` is the change (equations,) with a parallel plate.

        ``data`` are the values of the tangent, with ``held`` equations prescribed. SingularError if the tissue does not
        resist a rotation of the plate.
        """
        self._rotation = self._contact.status.rotation
        self._arms = self._contact.arms_mm(state)
        self._on_plate = _unknowns(self._contact.held)
        ways = np.zeros((len(state), 3))
        for axis in range(3):
            ways[self._on_plate, axis] = np.cross(np.eye(3)[axis], self._arms)
        acted = self._assembler.acting(state, ways)
        coupled = np.column_stack([self._assembler.by_equation(acted[:, axis]) for axis in range(3)])
        right = coupled.copy()
        right[held] = 0.0
        answers = np.column_stack([self._solver.solve(data, right[:, axis], _ACCURACY) for axis in range(3)])
        r, f = self._arms, forces[self._on_plate]
        curved = r.T @ f
        own = ways.T @ acted + 0.5 * (curved + curved.T) - (r * f).sum() * np.eye(3)
        missing = self._moment - self._contact.moment_nmm(state, forces)
        try:
            turn = np.linalg.solve(own - right.T @ answers, missing - coupled.T @ level)
        except np.linalg.LinAlgError as failure:
            raise SingularError("The tissue does not resist a rotation of the plate.") from failure
        return level - answers @ turn, turn

    def ahead(self, state: FloatArray, change: FloatArray, turn: FloatArray) -> FloatArray:
        """The state after a change of all unknowns and a rigid rotation of the nodes on the plate and of the plate."""
        turned = Rotation.from_rotvec(turn).as_matrix()
        tried = state + change
        tried[self._on_plate] += self._arms @ (turned - np.eye(3)).T
        self._contact.status = replace(self._contact.status, rotation=turned @ self._rotation)
        return np.asarray(tried)
