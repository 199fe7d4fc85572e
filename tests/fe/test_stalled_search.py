"""Newton's method that wanders about an equilibrium ends early, so that smaller increments or descent take over."""

import numpy as np

from dvc.arrays import FloatArray
from fe import NeoHooke, Tolerance
from fe.assembly import Assembler
from fe.elements import Model, element
from fe.linear import Solver
from fe.newton import Imposed, equilibrium
from tests.blocks import block


def test_a_residual_that_keeps_coming_back_ends_the_search() -> None:
    """Each time it is near equilibrium, a node jumps, as where skin wrinkles; half of the steps lower the residual."""
    model = Model.of(block((4, 3, 3), (8.0, 6.0, 6.0), 1), {"layer 0": NeoHooke.of(0.02)}, element("P1"))
    x = model.space.nodes_mm[:, 0]
    ends, inside = np.flatnonzero((x < 1e-9) | (x > 8.0 - 1e-9)), int(np.argmin(np.abs(x - 4.0)))
    assembler = Assembler(model, (3 * ends[:, None] + np.arange(3)).ravel(), {})
    told, jumps, most = list[str](), list[float](), 100

    def jumped(state: FloatArray, _forces: FloatArray) -> bool:
        if len(jumps) >= most:
            return False
        jumps.append(0.3 if len(jumps) % 2 else -0.3)
        state[3 * inside] += jumps[-1]
        return True

    state = np.zeros(model.unknowns)
    state[3 * inside] = 0.3
    search = assembler, Solver(assembler.indptr, assembler.indices), state, Imposed(np.zeros(assembler.size))
    assert equilibrium(*search, Tolerance(), jumped, told.append) is None
    assert len(jumps) > 2
    assert 12 <= len(told) < 30
    told.clear()
    jumps.clear()
    most = 3  # contact that has changed three times and then stays is no reason to end
    assert equilibrium(*search, Tolerance(), jumped, told.append) is not None
    assert len(jumps) == 3
    told.clear()
    assert equilibrium(*search, Tolerance(), log=told.append) is not None
    assert len(told) < 12
