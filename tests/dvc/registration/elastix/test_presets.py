"""Parameters: presets are known, users' files are checked by name and by component."""

from __future__ import annotations

import pytest

from dvc.errors import InputError, ParameterError
from dvc.registration.elastix.presets import load_preset, preset_names, read_parameter_file

GOOD = '(Transform "BSplineTransform")\n(Metric "AdvancedNormalizedCorrelation")\n(NumberOfResolutions 2)\n'


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_passes_its_own_check(name):
    assert load_preset(name).parameters["Transform"]


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ParameterError, match="heel-mr"):
        load_preset("heel-ct")


@pytest.mark.parametrize(
    ("line", "nearest"),
    [
        ("(MaximumNumberOfIteration 500)", "MaximumNumberOfIterations"),
        ("(NumberOfSpatialSample 500)", "NumberOfSpatialSamples"),
        ('(Metrics "AdvancedMeanSquares")', "Metric"),
        ("(FinalGridSpacingInPhysicalUnit 4.0)", "FinalGridSpacingInPhysicalUnits"),
    ],
)
def test_row_10_a_misspelt_parameter_is_refused_with_the_nearest_known(tmp_path, line, nearest):
    path = tmp_path / "mine.txt"
    path.write_text(GOOD + line)
    with pytest.raises(ParameterError, match=rf"mine\.txt: .*closest known name is '{nearest}'"):
        read_parameter_file(path)
    assert read_parameter_file(path, allow_unknown=True).parameters["Transform"] == ("BSplineTransform",)


@pytest.mark.parametrize(
    "line",
    [
        "(Metric0Weight 1.0)", "(Metric1Use \"true\")", "(Metric1NumberOfHistogramBins 32)",
        "(ErodeFixedMask0 \"false\")",
        "(FixedImagePyramidSchedule 4 4 4 1 1 1)", "(SP_alpha 0.6)", "(BSplineInterpolationOrder 1)",
        "(Metric0RelativeWeight 0.1)", "(RandomSeed 3)", "(MaximumStepLength 0.5)", "(FinalGridSpacing 8)",
    ],
)  # fmt: skip
def test_parameters_that_elastix_reads_are_accepted(tmp_path, line):
    path = tmp_path / "mine.txt"
    path.write_text(GOOD + line)
    read_parameter_file(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Resolutions 2", "Resolutions 2.0", r"NumberOfResolutions takes whole numbers from 1 to 20; it has '2\.0'"),
        ("Resolutions 2", "Resolutions 99999999999", "from 1 to 20"),
        ("Resolutions 2", 'Resolutions ""', "from 1 to 20; it has ''"),
        ("(Number", "(MaximumNumberOfIterations 10 1e308)\n(Number", "MaximumNumberOfIterations takes whole numbers"),
        ("(Number", "(MaximumNumberOfIterations 500 nan)\n(Number", "has the value 'nan', which is not finite"),
        ("(Number", "(MaximumStepLength 1e400)\n(Number", "has the value '1e400', which is not finite"),
        ("(Number", "(FinalGridSpacingInPhysicalUnits wide)\n(Number", "takes lengths above 0 mm; it has 'wide'"),
        ("(Number", "(FinalGridSpacingInPhysicalUnits 8 0 8)\n(Number", "takes lengths above 0 mm; it has '8 0 8'"),
        ("(Number", '(FinalGridSpacingInPhysicalUnits "")\n(Number', "takes lengths above 0 mm; it has ''"),
        ("(Number", "(FinalGridSpacingInPhysicalUnits -8)\n(Number", "takes lengths above 0 mm; it has '-8'"),
        ("Resolutions 2", "Resolutions 2\0\0", "characters that are no text"),
        ('"BSplineTransform"', '""', r'\(Transform "\.\.\."\) is missing'),
    ],
)
def test_values_that_elastix_cannot_count_with_are_refused(tmp_path, old, new, message):
    path = tmp_path / "mine.txt"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(ParameterError, match=message):
        read_parameter_file(path)


def test_real_files_of_others_are_accepted(real_data):
    path = real_data / "lung-landmarks" / "parameters.3D.NC.bspline.ASGD.001a.txt"
    assert "BSpline" in read_parameter_file(path).transform


def test_an_unknown_component_is_refused(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text(GOOD.replace("AdvancedNormalizedCorrelation", "AdvancedNormalisedCorrelation"))
    with pytest.raises(ParameterError, match=r"no Metric .*'AdvancedNormalizedCorrelation'"):
        read_parameter_file(path)


def test_a_broken_line_names_file_and_line(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text(GOOD + "(MaximumNumberOfIterations 500\n")
    with pytest.raises(ParameterError, match=r"mine\.txt.*4"):
        read_parameter_file(path)


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.txt"):
        read_parameter_file(tmp_path / "nowhere.txt")


def test_iterations_add_up_over_resolutions():
    assert load_preset("heel-mr").iterations == 3 * 1000 + 500
    assert load_preset("heel-mr").complete(seed=7)["RandomSeed"] == ("7",)
