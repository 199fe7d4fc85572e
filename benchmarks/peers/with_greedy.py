"""greedy: greedy diffeomorphic registration with weighted local normalised correlation."""

import SimpleITK as sitk
from exchange import arguments
from picsl_greedy import Greedy3D

METRIC = "WNCC 4x4x4"
SIGMAS = "3.0vox 0.5vox"  # of the update, of the whole
ITERATIONS = "200x200x100x50"
MASK_WIDER = 2  # voxels


def main() -> None:
    folder, threads = arguments()
    fixed = sitk.ReadImage(str(folder / "reference.mha"), sitk.sitkFloat32)
    moving = sitk.ReadImage(str(folder / "loaded.mha"), sitk.sitkFloat32)
    mask = sitk.BinaryDilate(sitk.ReadImage(str(folder / "mask.mha"), sitk.sitkUInt8), [MASK_WIDER] * 3)
    greedy = Greedy3D()
    # -wp 0: greedy would round the displacement to a tenth of a voxel
    greedy.execute(
        f"-threads {threads} -i fixed moving -gm mask -m {METRIC} -n {ITERATIONS} -s {SIGMAS} -wp 0 -o found",
        fixed=fixed,
        moving=moving,
        mask=sitk.Cast(mask, sitk.sitkFloat32),
        found=None,
    )
    sitk.WriteImage(greedy["found"], str(folder / "found.mha"))


if __name__ == "__main__":
    main()
