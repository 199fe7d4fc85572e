"""How functions of one point are compiled."""

from dvc.compiled import njit

at_point = njit(cache=True, _nrt=False)
"""Compiles a function that a kernel calls for each of its points, and that makes no array.

References to the arrays that it is given are not counted: the kernel holds them, and to count them at every call, in
steps that no other thread may come between, took a third of the time in which a flow carries points.
"""
