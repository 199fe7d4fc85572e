"""A measurement compared with finite-element models under one or several loads: figures, files, notebook, plots."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from dvc import LabelMap, TetMesh, Verdict
from dvc.atomic_files import whole_folder, write_json
from dvc.errors import InputError
from dvc.report.page import Picture, Section, Table, notebook_html, record_lines, write_report
from dvc.report.sheet import png_bytes
from dvc.trust.verdict import worst
from validate import figures, tables
from validate.agreement import Agreement, SkinDisplacement
from validate.curves import Area
from validate.extrapolation import LEVELLED
from validate.limitations import doubts_of, limitations, verdict_on
from validate.load_comparison import NOTHING, Criteria, LoadCase, LoadComparison, compare_load
from validate.location import Overlap
from validate.mapping import ALL
from validate.misfit import check_models, displacement_slip
from validate.ranking import ALL_LOADS, Ranking, rank_over_loads
from validate.report import area_rows, closing_sections, draw, load_sections, overview, shown
from validate.tables import Curve


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """One measurement compared with finite-element models.

    Attributes
    ----------
    areas, overlaps, agreements, skin : tuple of Area, Overlap, Agreement, SkinDisplacement
        Rows by load and model: area between volume-strain curves by tissue, location of clusters above thresholds,
        agreement cell by cell, displacement of the skin.
    curves : tuple of Curve
        Volume-strain curves, measured and simulated.
    ranking : Ranking
        Of the models, over all loads and under each.
    strains : (low, high)
        Range of maximum shear strain of the areas.
    coverage_ml : mapping of load to mapping
        Volume of the mesh, of what each field defines of it, and of what is common to all.
    verdict, verdicts : Verdict or None, mapping of load to Verdict or None
        On the registrations and on slips of the models, None where nothing is known; and on each registration.
    notes, warnings : tuple of str
        Limitations of this comparison, and what looks wrong about a model.
    loads : tuple of LoadComparison
        Fields, by load; empty for a comparison that was read back.
    """

    areas: tuple[Area, ...]
    overlaps: tuple[Overlap, ...]
    agreements: tuple[Agreement, ...]
    skin: tuple[SkinDisplacement, ...]
    curves: tuple[Curve, ...]
    ranking: Ranking
    strains: tuple[float, float]
    coverage_ml: Mapping[str, Mapping[str, float]]
    verdict: Verdict | None
    verdicts: Mapping[str, Verdict | None]
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    loads: tuple[LoadComparison, ...] = ()

    def summary(self) -> list[str]:
        """Verdict, areas, and which differences are significant, a line each."""
        lines = [] if self.verdict is None else [f"Verdict on the inputs: {self.verdict.words}"]
        for load in self.coverage_ml:
            areas = {a.model: a for a in self.areas if (a.load, a.tissue) == (load, ALL) and a.model != NOTHING}
            ranked = sorted((a for a in areas.values() if not a.model.endswith(LEVELLED)), key=lambda a: a.best_ml)
            lines.append(f"{load}: area between curves, mL, best first: {_listed(ranked)}")
            for name in (name for name in areas if name.endswith(LEVELLED)):
                before = areas[name.removesuffix(LEVELLED)].ml if name.removesuffix(LEVELLED) in areas else np.nan
                lines.append(f"{load}: {name} {areas[name].ml:.2f} as measured, {before:.2f} before levelling")
        if len(self.coverage_ml) > 1 and self.ranking.areas:
            lines.append(f"All loads: {_listed(self.ranking.areas)}")
        return [*lines, *self.ranking.statements, *self.notes]

    def __str__(self) -> str:
        return "\n".join(self.summary())

    def _repr_html_(self) -> str:
        """For a notebook: the answer, the areas of all soft tissue, and the curves."""
        loads = list(self.coverage_ml)
        head = ("model", "rank", *loads, *(["all loads"] if len(loads) > 1 else []))
        rows = tuple(row[: len(head)] for row in area_rows(self.areas, self.ranking, loads))
        low, high = self.strains
        title = f"Area between volume-strain curves, maximum shear strain {low:g} to {high:g}, mL (95 % interval)"
        picture = Picture("Volume-strain curves", "", png_bytes(self.plot()))
        words = [] if self.verdict is None else [f"Verdict on the inputs: {self.verdict.words}.", *self.verdict.reasons]
        return notebook_html(self._answer(), picture, Table(title, head, rows), notes=words)

    def _answer(self) -> str:
        """One sentence: the best match, or for a single model its area."""
        if self.ranking.statements:
            return self.ranking.statements[0]
        ranked = self.ranking.areas or [a for a in self.areas if a.tissue == ALL and a.model != NOTHING]
        best = min(ranked, key=lambda a: a.best_ml)
        return f"{best.model}: area between curves {shown(best)} mL ({best.load}), normalised {best.share:.1%}."

    def plot(self, kind: Literal["curves", "areas"] = "curves", *, tissue: str = ALL) -> Figure:
        """Draw volume-strain curves, a panel for each load, or the areas between them with their 95 % intervals.

        Raises
        ------
        InputError
            If there is no such kind of plot, or no such tissue.
        """
        tissues = dict.fromkeys(c.tissue for c in self.curves)
        if tissue not in tissues:
            raise InputError(f"No tissue '{tissue}' is compared; there are {', '.join(tissues)}.")
        if kind == "curves":
            return figures.curves_by_load([c for c in self.curves if c.tissue == tissue], self.strains)
        if kind == "areas":
            return figures.areas_by_load([a for a in self.areas if a.tissue == tissue and a.model != NOTHING])
        raise InputError(f"A comparison has plots of 'curves' and 'areas', none of '{kind}'.")

    def write(
        self,
        folder: Path | str,
        *,
        record: Mapping[str, object] | None = None,
        methods: Sequence[str] = (),
        on_image: bool = False,
    ) -> tuple[tuple[Section, ...], tuple[Section, ...]]:
        """Write tables, fields, pictures and a report, as `mrstrain compare` does; an earlier comparison is replaced.

        It gives the sections of the report, and the closing ones.

        Parameters
        ----------
        folder : path
            Gets ``report.html``, ``comparison.json``, tables, and a folder for each load.
        record : mapping, optional
            Provenance, kept in the JSON files; by default the range of the areas.
        methods : sequence of str
            Paragraphs for a methods section.
        on_image : bool
            Also write each model's displacement and maximum shear strain on the voxels of the label map.

        Raises
        ------
        InputError, OutputError
            If the comparison was read back, without its fields; if the folder cannot be written.
        """
        if not self.loads:
            raise InputError("A comparison that was read back has no fields to write; copy its folder instead.")
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        tables.remove_earlier(target, list(self.coverage_ml))
        about = dict(record) if record is not None else {"parameters": {"strains": list(self.strains)}}
        colours = list(dict.fromkeys(name for one in self.loads for name in one.fields.models))
        notes = [note for note in self.notes if note not in doubts_of(self.verdict)]
        sections = [overview(self.loads, self.ranking, self.warnings, notes)]
        for one in self.loads:
            pictures, viewer = draw(one, colours)
            with whole_folder(target / one.load) as part:
                tables.write_fields(part / "fields.vtu", one)
                for stem, picture in pictures.items():
                    (part / f"{stem}.png").write_bytes(picture.png)
                if on_image:
                    tables.write_on_image(part, one)
                write_json(part / "provenance.json", about | {"verdict": _plain(one.case.verdict)})
            sections += load_sections(one, pictures, viewer)
        self._write_tables(target)
        write_json(target / tables.RECORD, self._record() | about)
        closing, title = closing_sections(self.loads[0].criteria.thresholds, methods), "Models against the measurement"
        write_report(target / "report.html", title, self.verdict, sections, closing, record_lines(about))
        return tuple(sections), tuple(closing)

    @classmethod
    def read(cls, folder: Path | str) -> Comparison:
        """Read a comparison from its folder, to the six digits of the tables, without the fields in the cells.

        Raises
        ------
        InputError
            If the folder holds no comparison.
        """
        place = Path(folder)
        areas, overlaps, agreements, skin = tables.read_tables(place)
        try:
            content = json.loads((place / tables.RECORD).read_text(encoding="utf-8"))
            low, high = content["parameters"]["strains"]
            pairs = {load: tuple((a, b) for a, b in of) for load, of in content["not_told_apart"].items()}
            verdicts = {load: _verdict(of) for load, of in content["verdict_by_load"].items()}
            *totals, nothing = (a for a in areas if a.load == ALL_LOADS)
            ranking = Ranking(tuple(totals), nothing, tuple(content["told_apart"]), pairs)
            coverage, verdict, notes = content["coverage_ml"], _verdict(content["verdict"]), tuple(content["notes"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{place / tables.RECORD} is no record of a comparison ({error}).") from error
        by_load, curves = tuple(a for a in areas if a.load != ALL_LOADS), tables.read_curves(place)
        return cls(
            by_load, overlaps, agreements, skin, curves, ranking, (low, high), coverage, verdict, verdicts, notes
        )

    def _write_tables(self, target: Path) -> None:
        known = {load: of for load, of in self.verdicts.items() if of is not None}
        levels = {load: of.level for load, of in known.items()}
        levels |= {ALL_LOADS: worst(known.values()).level} if known else {}
        areas = (*self.areas, *self.ranking.areas, self.ranking.nothing)
        rows = (areas, self.overlaps, self.agreements, self.skin)
        tables.write_tables(target, rows, self.curves, levels)

    def _record(self) -> dict[str, object]:
        return {
            "total_area_ml": {a.model: a.best_ml for a in self.ranking.areas},
            "told_apart": list(self.ranking.statements),
            "not_told_apart": self.ranking.not_distinguishable,
            "notes": list(self.notes),
            "coverage_ml": self.coverage_ml,
            "verdict": _plain(self.verdict),
            "verdict_by_load": {load: _plain(verdict) for load, verdict in self.verdicts.items()},
        }


def compare(
    cases: Sequence[LoadCase],
    labels: LabelMap,
    bones: Sequence[str] = ("bone",),
    *,
    mesh: TetMesh | None = None,
    criteria: Criteria | None = None,
    notes: Sequence[str] = (),
    warnings: Sequence[str] | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Comparison:
    """Compare models with a measurement of one or several loads.

    Parameters
    ----------
    cases : sequence of LoadCase
        Each with at least one model.
    labels, bones : LabelMap, sequence of str
        Tissues of the unloaded image, and which of them are bone.
    mesh : TetMesh, optional
        Where fields are compared; by default the mesh of each load's first model.
    notes : sequence of str
        What else is known about the models.
    warnings : sequence of str, optional
        What `check_models` gave; by default the models are checked here.
    progress : callable
        Gets the fraction done.

    Raises
    ------
    InputError, GeometryError
        As `check_models` and `map_fields`.
    """
    by = criteria or Criteria()
    odd = list(check_models(cases, labels, bones) if warnings is None else warnings)
    loads: list[LoadComparison] = []
    for number, case in enumerate(cases):
        progress(number / len(cases))
        loads.append(compare_load(case, labels, bones, mesh=mesh, criteria=by))
        fields = loads[-1].fields
        odd += [f"{case.load}: {slip}" for name in fields.models if (slip := displacement_slip(fields, name))]
    verdict = verdict_on({case.load: case.verdict for case in cases}, odd)
    return Comparison(
        areas=tuple(a for one in loads for a in one.areas),
        overlaps=tuple(o for one in loads for o in one.overlaps),
        agreements=tuple(a for one in loads for a in one.agreements),
        skin=tuple(s for one in loads for s in one.skin),
        curves=tuple(curve for one in loads for curve in tables.curves_of(one)),
        ranking=rank_over_loads(loads),
        strains=by.strains,
        coverage_ml={one.load: one.fields.coverage() for one in loads},
        verdict=verdict,
        verdicts={case.load: case.verdict for case in cases},
        notes=(*notes, *doubts_of(verdict), *limitations(loads)),
        warnings=tuple(odd),
        loads=tuple(loads),
    )


def _listed(areas: Sequence[Area]) -> str:
    return ", ".join(f"{a.model} {shown(a)}" for a in areas)


def _plain(verdict: Verdict | None) -> dict[str, object] | None:
    return None if verdict is None else verdict.as_dict()


def _verdict(content: Mapping[str, object] | None) -> Verdict | None:
    return None if content is None else Verdict(content["level"], tuple(content["reasons"]))  # type: ignore[arg-type]
