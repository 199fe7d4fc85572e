"""Mesh files of other programs, and results on a mesh: Abaqus, ANSYS, CalculiX, FEBio, Gmsh and VTK."""
