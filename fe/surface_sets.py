"""Names of a mesh's surfaces, which are sets of facets; case does not count in them."""

from collections.abc import Sequence

from dvc import TetMesh

BONE, SKIN, CUT = "bone", "skin", "cut"
"""The interface with bone, which is fixed; the outer surface, which the plate may touch; and where a label map ends."""


def fixed_facets(mesh: TetMesh, beside: Sequence[str]) -> tuple[str, ...]:
    """Names of the facets that do not move: the bone's and those ``beside`` it, as the mesh spells them."""
    spelt = {name.casefold(): name for name in mesh.facets} | {name: name for name in mesh.facets}
    return tuple(dict.fromkeys([BONE, *(spelt.get(name, spelt.get(name.casefold(), name)) for name in beside)]))
