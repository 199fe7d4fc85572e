"""What must not go wrong, row by row: what is given, what is expected, and the tests that show it.

The tests of a row are there, are collected, and at least one of them runs in `make test`. The messages of refusals are
looked at in `tests/test_refusals.py`.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
IMAGES, STUDIES, MEASURED = "dvc/io/images/test_", "mrstrain/studies/test_", "mrstrain/measurement/test_"
READ, LABELS, REGISTER = f"{IMAGES}read.py::", f"{IMAGES}labels.py::", "dvc/registration/test_register.py::"
FIT, RUN, ONE = f"{LABELS}TestFitMask::", f"{STUDIES}run.py::", f"{MEASURED}register_and_strain.py::"


class Row(NamedTuple):
    """What is given, what is expected, and the tests that show it, each as ``file::test`` below ``tests``."""

    given: str
    expected: str
    tests: tuple[str, ...]


ROWS = {
    1: Row(
        "a truncated NIfTI, MetaImage, NRRD or DICOM file", "refuse",
        (f"{READ}test_a_file_cut_short_is_refused", f"{READ}test_a_whole_stream_of_too_few_voxels_is_refused",
         f"{IMAGES}dicom.py::test_a_slice_cut_short_is_refused",
         f"{IMAGES}nrrd.py::test_a_detached_file_cut_short_is_refused",
         f"{IMAGES}dicom_enhanced_refused.py::test_a_file_cut_anywhere_is_refused"),
    ),
    2: Row(
        "NaN or infinite voxels", "refuse with count and first index; an option masks them",
        (f"{READ}TestRefusedValues::test_not_finite", f"{REGISTER}test_missing_voxels_are_left_out"),
    ),
    3: Row(
        "a mask that is empty, does not overlap, has other values", "refuse; list what is found",
        (f"{LABELS}TestReadMask::test_empty", f"{LABELS}TestReadMask::test_several_values_are_listed"),
    ),
    4: Row(
        "a mask whose grid differs in the last digits", "accept, on the image's grid",
        (f"{FIT}test_last_digits_take_the_image_s_geometry",),
    ),
    5: Row(
        "a mask or labels on a cropped or coarser grid", "resample, and say so",
        (f"{FIT}test_a_cropped_grid", f"{FIT}test_a_coarser_finer_or_turned_grid"),
    ),
    6: Row(
        "a mask in another frame", "refuse",
        (f"{FIT}test_another_frame_is_refused_with_both_boxes",
         f"{FIT}test_a_header_of_the_other_handedness_is_refused"),
    ),
    7: Row(
        "qform against sform, a sheared affine, other units", "refuse; convert units and say so",
        (f"{IMAGES}nifti.py::test_qform_and_sform_that_disagree_are_refused",
         f"{IMAGES}nifti.py::test_a_sheared_affine_is_refused",
         f"{IMAGES}nifti.py::test_other_units_are_converted_and_told",
         f"{IMAGES}nrrd.py::test_other_units_are_converted_and_told"),
    ),
    8: Row(
        "a constant image, one image twice, a 2D image, one slice", "refuse",
        (f"{READ}TestRefusedValues::test_constant", f"{READ}TestRefusedValues::test_too_few_slices",
         f"{REGISTER}test_row_8_identical_images_are_refused",
         f"{MEASURED}series.py::test_row_8_one_image_given_twice_is_refused_before_anything_is_made"),
    ),
    9: Row(
        "a loaded image far away", "register, or refuse",
        (f"{REGISTER}test_row_9_a_foot_moved_by_20_mm_and_15_degrees_is_found",
         f"{REGISTER}test_row_9_another_centre_is_no_obstacle",
         f"{REGISTER}test_row_9_an_image_without_the_bone_is_refused"),
    ),
    10: Row(
        "a misspelt elastix parameter", "refuse with the nearest name; an option allows it",
        ("dvc/registration/elastix/test_presets.py::"
         "test_row_10_a_misspelt_parameter_is_refused_with_the_nearest_known",),
    ),
    11: Row(
        "a registration that folds or fits badly", "kept; \"do not trust\" in every output",
        ("dvc/trust/test_quality.py::test_row_11_folding_is_found_with_its_place_and_not_trusted",
         "dvc/trust/test_quality.py::test_a_poor_or_falling_similarity_costs_trust",
         "mrstrain/comparison/test_verdict.py::test_do_not_trust_is_said_in_everything",
         f"{STUDIES}page.py::test_a_registration_that_is_not_to_be_trusted_heads_the_report"),
    ),
    12: Row(
        "a DICOM gap, duplicate slice, several series or echoes", "refuse, or list the series",
        (f"{IMAGES}dicom.py::test_a_gap_is_refused_by_position",
         f"{IMAGES}dicom.py::test_a_duplicate_is_refused_by_position",
         f"{IMAGES}dicom.py::test_mixed_series_are_listed_and_chosen_from",
         f"{IMAGES}dicom_enhanced.py::test_several_images_in_a_file_are_listed_and_chosen_from"),
    ),
    13: Row(
        "a header that claims terabytes", "refuse with the estimate",
        (f"{IMAGES}nifti.py::test_a_header_that_claims_terabytes_is_refused_with_the_estimate",
         f"{READ}test_size_is_limited_from_the_header", f"{IMAGES}dicom.py::test_the_size_is_limited"),
    ),
    14: Row(
        "an input changed since the last run", "done again, by its contents",
        (f"{STUDIES}pipeline.py::test_changed_content_of_the_same_size_is_done_again_and_what_builds_on_it",
         f"{RUN}test_only_what_changed_is_done_anew"),
    ),
    15: Row(
        "kill -9 at every stage", "no half-written output; the same result",
        (f"{RUN}test_killed_in_any_stage_and_run_again_gives_the_same",
         "fe/test_restart.py::test_a_killed_command_goes_on_where_it_was"),
    ),
    16: Row(
        "a worker that is killed, crashes or hangs", "stage and case named; the others finish",
        (f"{RUN}test_a_registration_whose_process_is_killed_is_tried_once_more",
         "dvc/test_worker.py::test_death_is_an_error_that_says_so_and_the_next_task_runs",
         f"{STUDIES}machine.py::test_a_stage_that_hangs_is_named_then_ended_and_the_others_finish",
         f"{STUDIES}machine.py::test_memory_that_runs_out_counts_as_a_process_that_died"),
    ),
    17: Row(
        "a full disk, a folder that cannot be written, output over an input", "refuse; inputs untouched",
        (f"{ONE}test_row_17_outputs_never_replace_inputs",
         f"{ONE}test_row_17_an_output_that_cannot_be_a_folder_is_refused_first",
         f"{MEASURED}series.py::test_row_17_a_disk_too_small_for_all_loads_is_told_first",
         f"{IMAGES}write.py::test_a_full_disk_leaves_the_old_file_and_nothing_else",
         f"{STUDIES}machine.py::test_a_stage_whose_record_a_disk_does_not_take_is_named_and_made_again"),
    ),
    18: Row(
        "labels without a tissue; meshing that does not end", "refuse, naming it; a time limit",
        ("fe/test_meshing.py::test_what_cannot_be_meshed_is_refused",
         "fe/test_meshing.py::test_meshing_that_does_not_end_is_ended",
         f"{STUDIES}check.py::test_a_tissue_without_a_law_is_told_and_one_that_takes_anothers_is_not"),
    ),
    19: Row(
        "inverted or degenerate elements, unused nodes, metres, another order", "refuse, or renumber and say so",
        ("dvc/test_mesh.py::test_degenerate_cells_are_refused_with_their_count_and_the_first",
         "dvc/test_mesh.py::test_a_mesh_that_folds_over_itself_is_refused",
         "dvc/test_mesh.py::test_a_unit_that_cannot_be_is_refused_with_the_option_to_use",
         "dvc/test_mesh.py::test_unused_nodes_are_dropped_and_the_others_keep_their_numbers",
         "dvc/test_mesh.py::test_all_cells_counted_the_other_way_round_are_renumbered_and_logged"),
    ),
    20: Row(
        "nu of 0.5, negative modulus, a law that loses stability", "refuse; outside the strain reached, report",
        ("fe/test_materials.py::test_numbers_that_cannot_be",
         "fe/test_materials.py::test_a_law_that_loses_stability_says_where",
         "mrstrain/models/test_simulate.py::"
         "test_a_law_that_is_not_stable_at_the_strain_reached_is_told_and_ends_with_status_1"),
    ),
    21: Row(
        "a load that the model cannot carry", "the last converged state, and the fraction reached",
        ("fe/test_simulate.py::test_a_load_too_large_ends_with_the_last_state_in_balance",
         "mrstrain/models/test_simulate.py::test_loads_that_cannot_be_reached_are_marked_in_every_file"),
    ),
    22: Row(
        "an FE result elsewhere, in another unit or frame", "refuse with both bounding boxes",
        ("validate/test_fe_result.py::test_what_does_not_lie_in_the_image_is_refused_with_what_would",
         "validate/test_misfit.py::test_refusals_show_both_boxes"),
    ),
    23: Row(
        "a study file's unknown key, wrong type, path outside; HTML in a name", "refuse; escape",
        (f"{STUDIES}file.py::test_everything_wrong_is_told_at_once_with_the_nearest_key",
         f"{STUDIES}file.py::test_refused",
         f"{ONE}test_row_23_html_in_a_name_is_escaped", "dvc/report/test_page.py::test_names_are_escaped_everywhere"),
    ),
    24: Row(
        "a patient's name or id in a header", "in no output",
        (f"{ONE}test_row_24_no_header_text_reaches_an_output",
         f"{IMAGES}write.py::test_nothing_of_a_patient_passes_from_input_to_output"),
    ),
    25: Row(
        "two runs in one output folder", "the second refuses",
        ("mrstrain/records/test_one_run_in_a_folder.py::test_a_second_run_is_refused_and_writes_nothing",
         "mrstrain/records/test_inputs.py::test_two_runs_do_not_write_to_one_folder"),
    ),
    26: Row(
        "one study twice on one mesh, on 1 or 2 threads", "the same figures",
        (f"{MEASURED}series.py::test_row_26_two_threads_give_the_same_bits_again",
         "fe/test_simulate.py::test_threads_do_not_change_the_digits_that_matter"),
    ),
    27: Row(
        "contrast that a similarity cannot follow", "refuse; name the measure that could",
        (f"{REGISTER}test_row_27_inverted_contrast_is_refused_and_the_measure_that_could_is_named",
         f"{REGISTER}test_row_27_mutual_information_follows_turned_contrast"),
    ),
}  # fmt: skip


@cache
def short_tests(file: str) -> dict[str, bool]:
    """The tests of a file, with the class they are in, and whether `make test` runs them."""
    found = dict[str, bool]()
    for node in ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8")).body:
        within = node.body if isinstance(node, ast.ClassDef) and node.name.startswith("Test") else [node]
        prefix = f"{node.name}::" if isinstance(node, ast.ClassDef) else ""
        for one in within:
            if isinstance(one, ast.FunctionDef) and one.name.startswith("test_"):
                marks = [ast.unparse(mark) for mark in one.decorator_list]
                found[prefix + one.name] = not any(
                    mark == "pytest.mark.full_size" or mark.startswith("pytest.mark.skip") for mark in marks
                )
    return found


@pytest.mark.parametrize("number", ROWS)
def test_every_row_has_tests_and_one_of_them_runs_in_make_test(number: int) -> None:
    tests = [one.split("::", 1) for one in ROWS[number].tests]
    assert not [f"{file}::{name}" for file, name in tests if name not in short_tests(file)]
    assert any(short_tests(file)[name] for file, name in tests)


def test_tests_that_name_a_row_are_in_the_table() -> None:
    """So that the table stays whole when tests are added."""
    named = {one for row in ROWS.values() for one in row.tests}
    for path in (ROOT / "tests").rglob("test_*.py"):
        file = path.relative_to(ROOT / "tests").as_posix()
        for name in short_tests(file):
            if name.startswith("test_row_"):
                assert any(one.startswith(f"{file}::") for one in named), name
                number = int(name.split("_")[2])
                assert any(one.startswith(f"{file}::") for one in ROWS[number].tests), f"{file}::{name}"
