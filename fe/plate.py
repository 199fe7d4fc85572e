"""A rigid plate that tissue touches: taped to it from the first touch on, or free to slide along it.

Its rotation adds three unknowns to the sparse system of all others. Nodes on a plate that turns by a small vector t
about its pivot c move by t x r, r = x - c. With f their internal forces, the moment is sum r x f, and the second
variation of the energy has, beside w_k . K w_l (w_k = e_k x r, K the tangent), the part of the curved path

    sum  (r f^T + f r^T) / 2 - (r . f) I,

which is symmetric. The system [K B; B^T C] [x; t] = [right; moment] is solved by elimination of x, so that K, its
pattern and its factorisation are those of a plate that does not turn.
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
_SAME_MM = 1e-6  # nodes whose heights differ by less touch together, whatever the frame does to the last digits
_LEAST_ARM_MM = 1e-3
_ACCURACY = 1e-3  # of the linear solutions for a rotation


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """A rigid, flat plate, large enough for the whole surface.

    Parameters
    ----------
    normal : (3,)
        Outward normal, from the tissue to the plate, LPS; the normal force on the tissue is opposite.
    shear : (3,)
        Direction of the shear force on the tissue, LPS; what it has along the normal is taken out.
    gap_mm : float
        Distance from the surface that it will touch first, at the start.
    taped : bool
        Whether a node that has touched never slides or leaves again; if not, it slides without friction, and may leave.
    turns : bool
        Whether it turns freely about its pivot, in all three axes, once it presses; if not, it stays parallel.
    pivot_mm : (3,), optional
        Point in front of which the pivot lies on the plate's face at the start, LPS; by default the place on the
        surface that is touched first. The pivot moves with the plate, and moments are given about it.

    Attributes
    ----------
    axes : (3, 3)
        Columns are the plate's axes at the start, LPS: that of the normal force on the tissue, of shear, and their
        cross product.

    Raises
    ------
    InputError
        If a direction is not three finite numbers or is zero, or the two are parallel; if the gap is negative, the
        pivot is no point, or a plate without tape turns.
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
            raise InputError("A plate without friction that turns would slip off: let it turn on tape, or stay level.")
        if self.pivot_mm is not None:
            pivot = np.asarray(self.pivot_mm, dtype=np.float64)
            if pivot.shape != (3,) or not np.isfinite(pivot).all():
                raise InputError(f"The plate's pivot is a point, three finite coordinates in mm; got {self.pivot_mm}.")
        object.__setattr__(self, "axes", plate_axes(-frozen(self.normal, np.float64), self.shear))


@dataclass(frozen=True, slots=True, eq=False)
class ContactStatus:
    """Which nodes are in contact with the plate, where on it, and how it is turned."""

    nodes: BoolArray  # (s,) of those that may touch
    places_mm: FloatArray  # (s, 3) from the pivot, along axes that turn with the plate; NaN without contact
    rotation: FloatArray  # (3, 3) of those axes against the plate's axes at the start
    turns: bool  # whether the plate turns freely now


class Contact:
    """The nodes on the plate, in the plate's axes at the start (the first is that of the normal force).

    ``nodes_mm`` (n, 3) are the reference positions of all nodes, ``surface`` (s,) those that may touch. InputError if
    other tissue lies nearer to the plate: the plate comes from the wrong side.
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
                f"The plate would pass through {face_mm - nearest:.1f} mm of tissue that is not its surface "
                "before it touches that. Its normal points away from the tissue, on the side that is to be pressed."
            )

    @property
    def held(self) -> IntArray:
        """Nodes on the plate."""
        return self.nodes[self.status.nodes]

    @property
    def followers(self) -> dict[int, IntArray]:
        """Unknowns that follow each of the plate's three displacements."""
        return {axis: 3 * self.held + axis for axis in range(3 if self.plate.taped else 1)}

    def touch_first(self, state: FloatArray) -> None:
        """Move the plate to the surface, onto its lowest node or nodes."""
        places = np.where(self._first[:, None], (self._start - self._pivot) * [0.0, 1.0, 1.0], np.nan)
        self.status = replace(self.status, nodes=self._first, places_mm=places)
        state[3 * self.held] = self._pivot[0] - self._start[self._first, 0]

    def begin(self, state: FloatArray) -> None:
        """Remember a state of equilibrium, from which the next one is sought."""
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
        """From the pivot to each node on the plate (k, 3), mm."""
        return self._positions(state)[self.status.nodes] - self.centre_mm(state)

    def force_n(self, forces: FloatArray) -> FloatArray:
        """Force of the plate on the tissue (3,) N, from the internal forces of all unknowns."""
        return np.array([forces[self.followers.get(axis, np.empty(0, dtype=int))].sum() for axis in range(3)])

    def moment_nmm(self, state: FloatArray, forces: FloatArray) -> FloatArray:
        """Moment of the plate on the tissue about the pivot (3,) N mm."""
        return np.asarray(np.cross(self.arms_mm(state), forces[_unknowns(self.held)]).sum(axis=0))

    def update(self, state: FloatArray, forces: FloatArray) -> bool:
        """Take up nodes past the plate and, without tape, release those that it would pull; whether any changed.

        ``state`` is changed in place: nodes that touch are put onto the plate's face, along its normal and, on tape,
        across it to where they crossed the face on a straight way from the state before, as seen from the plate.
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
        """Positions (s, 3) from the pivot, along the axes that turn with the plate; past its face the first is < 0."""
        return np.asarray((self._positions(state) - self.centre_mm(state)) @ self.status.rotation)


def _unknowns(nodes: IntArray) -> IntArray:
    return np.asarray(3 * nodes[:, None] + np.arange(3))


class Parallel:
    """A plate that stays parallel: it has no unknowns of rotation."""

    def missing_n(self, state: FloatArray, forces: FloatArray) -> float:
        """Imbalance of the moment, N; none, as it takes up any."""
        return 0.0

    def solved(
        self, state: FloatArray, forces: FloatArray, data: FloatArray, level: FloatArray, held: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Change of every equation, ``level`` as it is, and the turn (3,), none."""
        return level, np.zeros(3)

    def ahead(self, state: FloatArray, change: FloatArray, turn: FloatArray) -> FloatArray:
        """The state after a change of all unknowns."""
        return state + change


class Turning(Parallel):
    """A plate that turns until its moment about the pivot is ``moment_nmm`` (3,); it turns ``contact`` in place."""

    def __init__(self, contact: Contact, assembler: Assembler, solver: Solver, moment_nmm: FloatArray) -> None:
        self._contact, self._assembler, self._solver = contact, assembler, solver
        self._moment = moment_nmm
        self._rotation = contact.status.rotation
        self._arms, self._on_plate = np.empty((0, 3)), np.empty((0, 3), dtype=int)

    def missing_n(self, state: FloatArray, forces: FloatArray) -> float:
        """Imbalance of the moment, N: over the root mean square arm of the nodes on the plate."""
        arm = float(np.sqrt((self._contact.arms_mm(state) ** 2).sum(axis=1).mean()))
        missing = self._moment - self._contact.moment_nmm(state, forces)
        return float(np.linalg.norm(missing)) / max(arm, _LEAST_ARM_MM)

    def solved(
        self, state: FloatArray, forces: FloatArray, data: FloatArray, level: FloatArray, held: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Change of every equation and the turn (3,), from ``level``, the change (equations,) of a level plate.

        ``data`` are the tangent's values, with ``held`` equations prescribed. SingularError if the tissue does not hold
        the plate against turning.
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
            raise SingularError("The plate is not held against turning.") from failure
        return level - answers @ turn, turn

    def ahead(self, state: FloatArray, change: FloatArray, turn: FloatArray) -> FloatArray:
        """The state after a change of all unknowns and a turn, rigid on the plate; the plate is turned to match."""
        turned = Rotation.from_rotvec(turn).as_matrix()
        tried = state + change
        tried[self._on_plate] += self._arms @ (turned - np.eye(3)).T
        self._contact.status = replace(self._contact.status, rotation=turned @ self._rotation)
        return np.asarray(tried)
