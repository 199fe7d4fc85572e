"""Finite-element models of soft tissue under load.

Conforming tetrahedral meshes from a label map, constitutive models, published material sets, fits of a model to a
stress-stretch curve, a solver for nearly incompressible tissue under a rigid plate, and input files for other solvers.
Imports from `dvc` only.

    import fe

    mesh, quality = fe.mesh_labels(labels, edge_mm=2.0)
    plate = fe.Plate(normal=(0.0, 0.0, -1.0), shear=(0.0, -1.0, 0.0))
    simulation = fe.simulate(mesh, fe.material_set("trebbi"), plate, [fe.LoadStep("Load1", normal_n=140.0)])
    print(simulation)

Geometry is LPS mm in the undeformed configuration, force N, stress MPa. Each name is loaded when it is first used, so
that `import fe` is quick.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
