"""A person's statements on the credibility of a model, after ASME V&V 40-2018 and FDA's guidance of 2023."""

from typing import ClassVar, Literal

from mrstrain.options.model import Options, Said

Grade = Literal["low", "medium", "high"]


class CredibilityOptions(Options):
    """Question, context of use, model risk, evidence from elsewhere, and the level reached by each factor.

    None stands for "not given". Nothing is graded by the program.
    """

    panel: ClassVar[str] = "Credibility"

    question_of_interest: Said = None
    """The question, decision or concern that the model helps to answer."""
    context_of_use: Said = None
    """Role and scope of the model in answering it: what is modelled, and how results are used beside other evidence."""
    quantities_of_interest: Said = None
    """Results of the model on which the answer rests."""
    model_influence: Grade | None = None
    """Weight of the model beside all other evidence for the decision."""
    decision_consequence: Grade | None = None
    """How serious the harm is if the decision is wrong."""
    model_risk: Grade | None = None
    """Model influence and decision consequence together, as you judge them."""
    risk_rationale: Said = None
    """Why these three are as given."""
    calibration: Said = None
    """Data that the model was calibrated with elsewhere, which are no evidence of validity."""
    bench_tests: Said = None
    """Comparisons with tests on the bench, such as with a phantom of known material."""
    population: Said = None
    """Comparisons with data of a population."""
    emergent_behaviour: Said = None
    """Known behaviour that the model reproduces although it was not built in."""
    plausibility: Said = None
    """Why the governing equations, assumptions and parameters are plausible."""
    applicability: Said = None
    """How the loads, tissues and subjects of the context of use differ from those compared here, and why it matters."""
    level_software_quality: Said = None
    """Level reached: software quality assurance."""
    level_code_verification: Said = None
    """Level reached: numerical code verification."""
    level_discretization_error: Said = None
    """Level reached: discretization error."""
    level_solver_error: Said = None
    """Level reached: numerical solver error."""
    level_use_error: Said = None
    """Level reached: use error."""
    level_model_form: Said = None
    """Level reached: model form."""
    level_model_inputs: Said = None
    """Level reached: model inputs."""
    level_test_samples: Said = None
    """Level reached: test samples."""
    level_test_conditions: Said = None
    """Level reached: test conditions."""
    level_input_equivalency: Said = None
    """Level reached: equivalency of input parameters."""
    level_output_comparison: Said = None
    """Level reached: output comparison."""
    level_relevance_of_quantities: Said = None
    """Level reached: relevance of the quantities of interest."""
    level_relevance_of_validation: Said = None
    """Level reached: relevance of the validation activities to the context of use."""
