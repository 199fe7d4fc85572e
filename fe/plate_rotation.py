"""A plate's rotation: three unknowns beside the sparse system of all others, and a turn that stays rigid.

Nodes on a plate that turns by a small vector t about its pivot c move by t x r, r = x - c. With f their internal
forces, the moment is sum r x f, and the second variation of the energy has, beside w_k . K w_l (w_k = e_k x r, K the
tangent), the part of the curved path

    sum  (r f^T + f r^T) / 2 - (r . f) I,

which is symmetric. The system [K B; B^T C] [x; t] = [right; moment] is solved by elimination of x, so that K, its
pattern and its factorisation are those of a plate that does not turn.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dvc.arrays import FloatArray, IntArray
from fe.assembly import Assembler
from fe.linear import SingularError, Solver
from fe.plate import Contact

_LEAST_ARM_MM = 1e-3
_ACCURACY = 1e-3  # of the linear solutions


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
        self._on_plate = 3 * self._contact.held[:, None] + np.arange(3)
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
