"""pyALDVC: subsets by inverse-compositional Gauss-Newton, made compatible by a global step (augmented Lagrangian)."""

from al_dvc import dvcpara_default, run_aldvc
from exchange import arguments, extrapolated, read_array, write_nodes

WINDOW = 8
STEP = 3
SEARCH = 6
SMOOTHING = 0.0


def main() -> None:
    folder, threads = arguments()
    # Its arrays are (z, y, x).
    reference, aligned, mask = (read_array(folder / f"{name}.mha").T for name in ("reference", "aligned", "mask"))
    settings = dvcpara_default(
        winsize=WINDOW,
        winstepsize=STEP,
        search_radius=SEARCH,
        global_shift=False,
        disp_smoothing=SMOOTHING,
        min_valid_ratio=0.3,
        backend="numba",
        n_threads=threads,
        verbose=False,
    )
    result = run_aldvc(settings, [reference, aligned], masks=[mask > 0, None], compute_strain=False)
    mesh = result.dvc_mesh
    u = mesh.to_grid(result.result_disp[0].U).transpose(2, 1, 0, 3)
    write_nodes(folder, extrapolated(u), [mesh.x0[0], mesh.y0[0], mesh.z0[0]], mesh.spacing)


if __name__ == "__main__":
    main()
