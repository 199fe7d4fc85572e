"""A rigid plate that tissue touches: taped to it from the first touch on, or free to slide along it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError
from dvc.kinematics import plate_axes

_BEYOND_MM = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Plate:
    """A rigid, flat plate, large enough for the whole surface; it does not turn.

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

    Attributes
    ----------
    axes : (3, 3)
        Columns are the plate's axes, LPS: that of the normal force on the tissue, of shear, and their cross product.
    """

    normal: npt.ArrayLike
    shear: npt.ArrayLike
    gap_mm: float = 0.0
    taped: bool = True
    axes: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.gap_mm) and self.gap_mm >= 0.0):
            raise InputError(f"The gap between plate and tissue must be 0 mm or more; got {self.gap_mm}.")
        object.__setattr__(self, "axes", plate_axes(-np.asarray(self.normal, dtype=np.float64), self.shear))


class Contact:
    """Which nodes hold to the plate, in the plate's axes (the first is that of the normal force).

    Parameters
    ----------
    plate : Plate
    nodes_mm : (n, 3)
        Reference positions of all nodes, plate's axes.
    surface : (s,) int
        Nodes that may touch.

    Raises
    ------
    InputError
        If tissue that may not touch lies nearer to the plate than all that may: the plate comes from the wrong side.
    """

    def __init__(self, plate: Plate, nodes_mm: FloatArray, surface: IntArray) -> None:
        self.plate = plate
        self.nodes = surface
        self._start = nodes_mm[surface]
        self.holds: BoolArray = np.zeros(len(surface), dtype=bool)
        self._face_mm = float(self._start[:, 0].min())
        self._before = np.zeros_like(self._start)
        nearest = float(nodes_mm[:, 0].min())
        if nearest < self._face_mm - _BEYOND_MM:
            raise InputError(
                f"The plate would pass through {self._face_mm - nearest:.1f} mm of tissue that is not its surface "
                "before it touches that. Its normal points away from the tissue, on the side that is to be pressed."
            )

    @property
    def followers(self) -> dict[int, IntArray]:
        """Unknowns that follow each of the plate's three displacements."""
        held = self.nodes[self.holds]
        return {axis: 3 * held + axis for axis in range(3 if self.plate.taped else 1)}

    @property
    def may_follow(self) -> dict[int, IntArray]:
        """Unknowns that may ever follow the plate's displacements."""
        return {axis: 3 * self.nodes + axis for axis in range(3)}

    def touch_first(self, state: FloatArray) -> None:
        """Move the plate to the surface: its lowest node holds."""
        self.holds = self._start[:, 0] <= self._face_mm
        state[3 * self.nodes[self.holds]] = 0.0

    def begin(self, state: FloatArray) -> None:
        """Remember a state of equilibrium, from which the next one is sought."""
        self._before = self._moved(state)

    def advance_mm(self, state: FloatArray) -> float:
        """How far the plate's face has come along the normal force since the first touch, mm."""
        return float((self._start[self.holds, 0] + self._moved(state)[self.holds, 0]).mean()) - self._face_mm

    def update(self, state: FloatArray, forces: FloatArray) -> bool:
        """Let nodes that are past the plate hold to it, and, without tape, those go that it would have to pull.

        Parameters
        ----------
        state : (unknowns,)
            Nodes that touch are put on the plate, in place: along its normal onto its face, and, on tape, across it to
            where they crossed the face on a straight way from the state before.
        forces : (unknowns,)
            Internal forces, N.

        Returns
        -------
        bool
            Whether any node was taken or let go.
        """
        now, before = self._moved(state), self._before
        plate = (now - before)[self.holds].mean(axis=0)  # its own movement in this step
        gap = self._start[:, 0] + now[:, 0] - (self._start[self.holds, 0] + now[self.holds, 0]).mean()
        new = (gap <= 0.0) & ~self.holds
        pulled = self.holds & (forces[3 * self.nodes] < 0.0) if not self.plate.taped else np.zeros_like(self.holds)
        gap_before = gap - (now - before)[:, 0] + plate[0]
        closed = np.maximum(gap_before - gap, 1e-12)
        share = np.clip(gap_before / closed, 0.0, 1.0)[:, None]
        crossed = before + share * (now - plate - before) + plate
        state[3 * self.nodes[new]] = (now[:, 0] - gap)[new]
        if self.plate.taped:
            for axis in (1, 2):
                state[3 * self.nodes[new] + axis] = crossed[new, axis]
        self.holds = (self.holds & ~pulled) | new
        return bool(new.any() or pulled.any())

    def _moved(self, state: FloatArray) -> FloatArray:
        return np.asarray(state[3 * self.nodes[:, None] + np.arange(3)])
