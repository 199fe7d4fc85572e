"""Comparison of a measurement with finite-element models under one or several loads: results, files and plots."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, Self

import numpy as np
from matplotlib.figure import Figure

from dvc import LabelMap, TetMesh, Verdict
from dvc.arguments import checked
from dvc.atomic_files import whole_folder, write_json
from dvc.errors import InputError, few
from dvc.file_names import refuse_as_file_name
from dvc.own_files import read_json
from dvc.report.drawing import png_bytes
from dvc.report.page import Banner, Picture, Section, Table, notebook_html, record_lines, write_report
from dvc.report.strips import Strip
from dvc.trust.verdict import worst
from dvc.worker import Each
from validate import figures, report, tables
from validate.agreement import Agreement, SkinDisplacement, regression_told
from validate.best_model import banner_of, without_banner
from validate.comparison_error import ComparisonError
from validate.curves import Area, range_told
from validate.decomposition import Representation
from validate.extrapolation import LEVELLED
from validate.limitations import limitations
from validate.load_comparison import NOTHING, Criteria, LoadCase, LoadComparison, compare_load
from validate.location import Overlap
from validate.mapping import ALL
from validate.mavm import ModelForm
from validate.misfit import Misfit, check_models, displacement_slip
from validate.ranking import ALL_LOADS, Ranking, no_nearer, rank_over_loads
from validate.report import Drawn, area_rows, closing_sections, drawings_of_all, load_sections, overview, shown
from validate.tables import Curve
from validate.verdict import judged_by, verdict_on


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """One measurement compared with finite-element models.

    Attributes
    ----------
    areas, overlaps, agreements, skin, errors : tuple of Area, Overlap, Agreement, SkinDisplacement, ComparisonError
        Rows by load and model: area between strain-volume curves by tissue, location of clusters above thresholds,
        agreement cell by cell, displacement of the skin, and comparison error of each figure with its uncertainties.
    representations, model_forms : tuple of Representation, ModelForm
        Rows by load, model and tissue: image decomposition (CWA 16799), modified area validation metric.
    curves : tuple of Curve
        Strain-volume curves, measured and simulated.
    ranking : Ranking
        Of the models, over all loads and under each.
    strains : (low, high)
        Range of maximum shear strain of the areas.
    coverage_ml : mapping of load to mapping
        Volume of the mesh, of the part in which each field is defined, and of the common part.
    verdict, verdicts : Verdict or None, mapping of load to Verdict or None
        Verdict on the inputs (registrations, and input errors of the models; None if there is neither), and on each
        registration.
    notes, warnings : tuple of str, tuple of Misfit
        Limitations of this comparison, and possible input errors of the models.
    loads : tuple of LoadComparison
        Fields, by load; empty for a comparison that was read from files.
    """

    areas: tuple[Area, ...]
    overlaps: tuple[Overlap, ...]
    agreements: tuple[Agreement, ...]
    skin: tuple[SkinDisplacement, ...]
    representations: tuple[Representation, ...]
    model_forms: tuple[ModelForm, ...]
    curves: tuple[Curve, ...]
    ranking: Ranking
    strains: tuple[float, float]
    coverage_ml: Mapping[str, Mapping[str, float]]
    verdict: Verdict | None
    verdicts: Mapping[str, Verdict | None]
    notes: tuple[str, ...]
    warnings: tuple[Misfit, ...] = ()
    loads: tuple[LoadComparison, ...] = ()
    errors: tuple[ComparisonError, ...] = ()

    def summary(self) -> list[str]:
        """Verdict, areas, best match, its slope and R², and significant differences, one line each."""
        lines = [] if self.verdict is None else [f"{self._judged}: {self.verdict.words}"]
        for load in self.coverage_ml:
            areas = {a.model: a for a in self.areas if (a.load, a.tissue) == (load, ALL)}
            nothing = areas.pop(NOTHING)
            levelled = {name: a for name, a in areas.items() if name.endswith(LEVELLED)}
            ranked = sorted((a for name, a in areas.items() if name not in levelled), key=lambda a: a.best_ml)
            informative = load not in self.ranking.uninformative
            listed = _listed(ranked, nothing, informative)
            lines.append(f"{load}: {self._area}, mL, {'best first' if informative else 'not informative'}: {listed}")
            for name, area in levelled.items():
                before = areas[name.removesuffix(LEVELLED)].ml if name.removesuffix(LEVELLED) in areas else np.nan
                lines.append(f"{load}: {name} {area.ml:.2f} by forward-model comparison, {before:.2f} directly")
        if len(self.coverage_ml) > 1 and self.ranking.areas:
            informative = ALL_LOADS not in self.ranking.uninformative
            listed = _listed(self.ranking.areas, self.ranking.nothing, informative)
            lines.append(f"All loads, area in mL{'' if informative else ' (not informative)'}: {listed}")
        return [*lines, *self.statements, *self.notes]

    def __str__(self) -> str:
        return "\n".join(self.summary())

    def _repr_html_(self) -> str:
        """For a notebook: the best match, the areas of all soft tissue, and the curves."""
        loads = list(self.coverage_ml)
        columns = [*([ALL_LOADS] if len(loads) > 1 else []), *loads]
        head, rows = ("model", "rank", *columns), tuple(area_rows(self.areas, self.ranking, columns))
        interval = " (95 % interval)" if any(np.isfinite(area.low_ml) for area in self.areas) else ""
        title = f"Area between strain-volume curves, {range_told(self.strains)}, mL{interval}"
        picture = Picture("Strain-volume curves", "", png_bytes(self.plot()))
        words = [] if self.verdict is None else [f"{self._judged}: {self.verdict.words}.", *self.verdict.reasons]
        return notebook_html(self.headline, picture, Table(title, head, rows), notes=words)

    @property
    def _judged(self) -> str:
        return judged_by(self.verdict, self.verdicts)

    @property
    def statements(self) -> tuple[str, ...]:
        """Those of the ranking; after the first, slope and R² of the best match, cell by cell."""
        first, rest = self.ranking.statements[:1], self.ranking.statements[1:]
        told = regression_told(self.agreements, self.best)
        return (*first, *([told] if told else []), *rest)

    @property
    def banner(self) -> Banner | None:
        """What a report says of the models at first sight; None where that cannot be told."""
        return banner_of(self.ranking, self.errors, self.coverage_ml, self.verdict)

    @property
    def best(self) -> str:
        """The model with the smallest area over all loads; under any load, if no model has every load."""
        return self._best.model

    @property
    def _best(self) -> Area:
        """The area of the best model."""
        ranked = self.ranking.areas or [a for a in self.areas if a.tissue == ALL and a.model != NOTHING]
        return min(ranked, key=lambda a: (a.levelled, a.best_ml))

    @property
    def headline(self) -> str:
        """One sentence: the best match, or the area of a single model."""
        if best_match := next((line for line in self.ranking.statements if line.startswith("Best match")), None):
            return best_match
        best = self._best
        nothing = {a.load: a for a in (*self.areas, self.ranking.nothing) if (a.model, a.tissue) == (NOTHING, ALL)}
        worse = ", no better than a model without deformation" if no_nearer([best], nothing[best.load]) else ""
        return f"{best.model}: {self._area} {shown(best)} mL ({best.load}), normalised {100 * best.share:.1f} %{worse}."

    @property
    def _area(self) -> str:
        return f"area between strain-volume curves ({range_told(self.strains)})"

    def plot(self, kind: Literal["curves", "areas"] = "curves", *, tissue: str = ALL) -> Figure:
        """Draw strain-volume curves, a panel for each load, or the areas between them with their 95 % intervals.

        Raises
        ------
        InputError
            If the kind of plot or the tissue is unknown.
        """
        tissues = dict.fromkeys(c.tissue for c in self.curves)
        if tissue not in tissues:
            raise InputError(f"The tissue '{tissue}' is not compared; compared tissues are {few(tissues)}.")
        if kind == "curves":
            return figures.curves_by_load([c for c in self.curves if c.tissue == tissue], self.strains)
        if kind == "areas":
            return figures.areas_by_load([a for a in self.areas if a.tissue == tissue and a.model != NOTHING])
        raise InputError(f"Unknown plot '{kind}'; available are 'curves' and 'areas'.")

    def write(
        self, folder: Path | str, *, record: Mapping[str, object] | None = None, methods: Sequence[str] = (),
        more: Sequence[Section] = (), on_image: bool = False, largest: float | None = None, each: Each = map,
    ) -> tuple[tuple[Section, ...], tuple[Section, ...]]:  # fmt: skip
        """Write tables, fields, figures and a report, as `mrstrain compare` does; an earlier comparison is replaced.

        Returns the sections of the report, and its closing sections.

        Parameters
        ----------
        folder : path
            Gets ``report.html``, ``comparison.json``, tables, and a folder for each load.
        record : mapping, optional
            Provenance for the JSON files; by default the range of strain.
        methods : sequence of str
            Paragraphs for a methods section.
        more : sequence of Section
            Further closing sections of the report, before the methods text.
        on_image : bool
            Also write each model's displacement and maximum shear strain on the voxels of the label map.
        largest : float, optional
            Where the colours of the maximum shear strain end; by default as in `mrstrain.register`, in these cells.
        each : callable
            As in `validate.compare`.

        Raises
        ------
        InputError, OutputError
            If the comparison was read from files and so has no fields; if the folder cannot be written.
        """
        if not self.loads:
            raise InputError("A comparison that was read from files has no fields to write; copy its folder instead.")
        for of, names in (("load", self.coverage_ml), ("model", {n for one in self.loads for n in one.fields.models})):
            for name in names:
                refuse_as_file_name(of, name)
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        tables.remove_earlier(target, list(self.coverage_ml))
        about = dict(record) if record is not None else {"parameters": {"strains": list(self.strains)}}
        notes = [note for note in self.notes if note not in _doubts(self.verdict)]
        drawn, ends = report.drawing_of(self.loads, largest)
        write_one = partial(_write_load, folder=target, drawn=drawn, about=about, on_image=on_image)
        parts, strips = zip(*each(write_one, self.loads), strict=True)
        of_all = drawings_of_all(strips, self.curves, self.strains, self.ranking, ends)
        pictures = [drawing.save(target / stem) for stem, drawing in of_all.items()]
        first = overview(self.loads, self.ranking, self.warnings, (*self.statements, *notes), pictures)
        sections = [first, *(section for part in parts for section in part)]
        known = {load: of for load, of in self.verdicts.items() if of is not None}
        levels = {load: of.level for load, of in known.items()}
        levels |= {ALL_LOADS: worst(known.values()).level} if known else {}
        areas, ranking = (*self.areas, *self.ranking.areas, self.ranking.nothing), self.ranking
        rows = areas, self.overlaps, self.agreements, self.skin, self.representations, self.model_forms, self.errors
        tables.write_tables(target, rows, self.curves, levels)
        own: dict[str, object] = {
            "total_area_ml": {a.model: a.best_ml for a in ranking.areas}, "told_apart": list(ranking.statements),
            "not_told_apart": ranking.not_distinguishable, "notes": list(self.notes), "coverage_ml": self.coverage_ml,
            "not_informative": list(ranking.uninformative), "verdict": _plain(self.verdict),
            "verdict_by_load": {load: _plain(verdict) for load, verdict in self.verdicts.items()},
        }  # fmt: skip
        write_json(target / tables.RECORD, own | about)
        closing, title = closing_sections(self.loads[0].criteria.thresholds, methods, more), "Models and measurement"
        shown, page = [without_banner(first, self.banner), *sections[1:]], target / "report.html"
        lines = record_lines(about)
        write_report(page, title, self.verdict, shown, closing, lines, judged=self._judged, models=self.banner)
        return tuple(sections), tuple(closing)

    @classmethod
    def read(cls, folder: Path | str) -> Self:
        """Read a comparison from its folder, to the six digits of the tables, without the fields in the cells.

        Raises
        ------
        InputError
            If the folder does not contain a comparison.
        """
        place = Path(folder)
        areas, overlaps, agreements, skin, represented, forms, errors = tables.read_tables(place)
        try:
            content = read_json(place / tables.RECORD)
            low, high = content["parameters"]["strains"]
            pairs = {load: tuple((a, b) for a, b in of) for load, of in content["not_told_apart"].items()}
            verdicts = {load: _verdict(of) for load, of in content["verdict_by_load"].items()}
            *totals, nothing = (a for a in areas if a.load == ALL_LOADS)
            of_nothing = {a.load for a in areas if (a.model, a.tissue) == (NOTHING, ALL)} - {ALL_LOADS}
            if of_nothing != set(content["coverage_ml"]):
                raise ValueError("its loads are not those of the table of areas")
            few = tuple(content.get("not_informative", ()))  # older records do not tell
            ranking = Ranking(tuple(totals), nothing, tuple(content["told_apart"]), pairs, few)
            coverage, verdict, notes = content["coverage_ml"], _verdict(content["verdict"]), tuple(content["notes"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{place / tables.RECORD} is not a valid record of a comparison ({error}).") from error
        by_load, curves = tuple(a for a in areas if a.load != ALL_LOADS), tables.read_curves(place)
        rows = by_load, overlaps, agreements, skin, represented, forms
        return cls(*rows, curves, ranking, (low, high), coverage, verdict, verdicts, notes, errors=errors)


def _write_load(
    one: LoadComparison, folder: Path, drawn: Callable[..., Drawn], about: Mapping[str, object], on_image: bool
) -> tuple[list[Section], Strip]:
    """Write the folder of one load; return its sections of the report, and its part of the first figure."""
    drawings, viewer, strip = drawn(one)
    with whole_folder(folder / one.load) as part:
        tables.write_fields(part / "fields.vtu", one)
        pictures = {stem: drawing.save(part / stem) for stem, drawing in drawings.items()}
        if on_image:
            tables.write_on_image(part, one)
        write_json(part / "provenance.json", {**about, "verdict": _plain(one.case.verdict)})
    return load_sections(one, pictures, viewer), strip


@checked
def compare(
    cases: Sequence[LoadCase], labels: LabelMap, bones: Sequence[str] = ("bone",), *,
    mesh: TetMesh | None = None, criteria: Criteria | None = None, notes: Sequence[str] = (),
    warnings: Sequence[Misfit] | None = None, progress: Callable[[float], None] | None = None, each: Each = map,
) -> Comparison:  # fmt: skip
    """Compare models with a measurement of one or several loads.

    Parameters
    ----------
    cases : sequence of LoadCase
        Each with at least one model (`LoadCase.of`).
    labels, bones : LabelMap, sequence of str
        Tissues of the unloaded image, and which of them are bone. Without bone (an empty sequence) nothing is given by
        distance to bone, and no uncertainty.
    mesh : TetMesh, optional
        Mesh on which fields are compared; by default the mesh of the first model of each load.
    criteria : Criteria, optional
        Range of strains, thresholds, and seed of the draws.
    notes : sequence of str
        Further notes on the models.
    warnings : sequence of Misfit, optional
        Result of `check_models`; by default the models are checked here.
    progress : callable
        Called with the fraction done.
    each : callable
        `map`, or that of `dvc.worker.side_by_side`, which computes several loads at the same time in separate
        processes.

    Returns
    -------
    Comparison
        ``areas`` (mL) between the strain-volume curves, ``ranking`` over all loads, ``overlaps``, ``agreements``, the
        ``verdict`` and more, as tables of rows; `Comparison.write` makes the report.

    Raises
    ------
    InputError, GeometryError
        If two loads, or two models of one load, have the same name; if the label map lacks a bone; or if a model does
        not lie in the imaged tissue (wrong unit, frame or configuration). See `check_models`.
    """
    by = Criteria() if criteria is None else criteria
    odd = list(check_models(cases, labels, bones, each=each) if warnings is None else warnings)
    loads: list[LoadComparison] = []
    for one in each(partial(compare_load, labels=labels, bones=bones, mesh=mesh, criteria=by), cases):
        loads.append(replace(one, labels=labels))  # one label map for all; loads from other processes have copies
        slips = {name: displacement_slip(one.fields, name) for name in one.fields.models}
        odd += [Misfit(one.load, name, f"{one.load}: {slip}") for name, slip in slips.items() if slip]
        if progress is not None:
            progress(len(loads) / len(cases))
    verdicts = {case.load: case.verdict for case in cases}
    verdict, coverage = verdict_on(verdicts, odd), {one.load: one.fields.coverage() for one in loads}
    return Comparison(
        areas=tuple(a for one in loads for a in one.areas),
        overlaps=tuple(o for one in loads for o in one.overlaps),
        agreements=tuple(a for one in loads for a in one.agreements),
        skin=tuple(s for one in loads for s in one.skin),
        representations=tuple(r for one in loads for r in one.representations),
        model_forms=tuple(m for one in loads for m in one.model_forms),
        curves=tuple(curve for one in loads for curve in tables.curves_of(one)),
        ranking=rank_over_loads(loads, odd), strains=by.strains, coverage_ml=coverage,
        verdict=verdict, verdicts=verdicts, notes=(*notes, *_doubts(verdict), *limitations(loads)),
        warnings=tuple(odd), loads=tuple(loads), errors=tuple(error for one in loads for error in one.errors),
    )  # fmt: skip


def _doubts(verdict: Verdict | None) -> tuple[str, ...]:
    """Reasons of a verdict below trust."""
    return () if verdict is None or verdict.level == "trust" else verdict.reasons


def _listed(areas: Sequence[Area], nothing: Area, informative: bool) -> str:
    worse = ", ".join(no_nearer(areas, nothing)) if informative else ""
    listed = ", ".join(f"{a.model} {shown(a)}" for a in areas)
    return listed + (f"; no better than {NOTHING}, {shown(nothing)}: {worse}" if worse else "")


def _plain(verdict: Verdict | None) -> dict[str, object] | None:
    return None if verdict is None else verdict.as_dict()


def _verdict(content: Mapping[str, object] | None) -> Verdict | None:
    return None if content is None else Verdict(content["level"], tuple(content["reasons"]))  # type: ignore[arg-type]
