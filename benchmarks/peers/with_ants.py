"""ANTs: symmetric normalisation (SyN) with local normalised correlation."""

import ants
import SimpleITK as sitk
from exchange import arguments

RADIUS = 2
STEP = 0.2
UPDATE_SIGMA, TOTAL_SIGMA = 3.0, 0.0  # variance in voxels
ITERATIONS = (100, 100, 20)


def main() -> None:
    folder, _ = arguments()  # ANTs takes its threads from the environment
    fixed = ants.image_read(str(folder / "reference.mha"))
    moving = ants.image_read(str(folder / "loaded.mha"))
    mask = ants.morphology(ants.image_read(str(folder / "mask.mha")), "dilate", 4)
    found = ants.registration(
        fixed,
        moving,
        type_of_transform="SyNOnly",
        initial_transform="identity",
        mask=mask,
        mask_all_stages=True,
        syn_metric="CC",
        syn_sampling=RADIUS,
        grad_step=STEP,
        flow_sigma=UPDATE_SIGMA,
        total_sigma=TOTAL_SIGMA,
        reg_iterations=ITERATIONS,
        random_seed=1,
        outprefix=str(folder / "ants"),
    )
    warp = sitk.ReadImage(next(name for name in found["fwdtransforms"] if "Warp" in name))
    sitk.WriteImage(warp, str(folder / "found.mha"))  # in NIfTI a reader could not know that its vectors are LPS


if __name__ == "__main__":
    main()
