"""Measured deformation: MR images, alignment on bone, B-spline registration, strain, verdict and uncertainty.

The public interface; each name is loaded when it is first used. All geometry is LPS mm in the reference (unloaded)
configuration unless a docstring states otherwise. Where to start:

    import dvc

    reference, loaded = dvc.read_image("Load0.nii.gz"), dvc.read_image("Load1.nii.gz")
    measurement = dvc.measure(reference, loaded, bone=dvc.read_mask("calcaneus.nii.gz", reference.grid))
    print(measurement)
    measurement.write("Load1")
"""

import lazy_loader

from dvc.namesake import refuse_data_version_control

refuse_data_version_control()
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
