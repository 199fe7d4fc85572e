"""A pair of images as it was measured: arrays, quality, verdict and error bars; written, read and shown."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from dvc.arrays import Float32Array, FloatArray
from dvc.atomic_files import whole_folder, write_json
from dvc.deformation.protocol import Deformation, RigidMotion
from dvc.deformation.strain_maps import TENSOR_COMPONENTS, StrainMaps, strain_maps
from dvc.errors import InputError
from dvc.images.image import Image
from dvc.io import error_files, result_folder as files
from dvc.measurement import judgement, page
from dvc.measurement.error_bars import NO_ERROR_BARS, ErrorBars, error_bars
from dvc.measurement.judgement import Evidence, Source
from dvc.measurement.stored import figures_to_store, read_stored
from dvc.measurement.subject import Subject
from dvc.registration.align import without_motion
from dvc.registration.register import Registration
from dvc.report.drawing import Drawing, png_bytes
from dvc.report.figures import Scale, coloured
from dvc.report.page import Picture, Section, notebook_html
from dvc.report.sheet import PLANES, Plane, View
from dvc.trust.assessment import assess
from dvc.trust.components import ComponentUncertainty
from dvc.trust.field_draws import TrueField
from dvc.trust.quality import Quality, noise_floor
from dvc.trust.regions import RegionRow, region_statistics, write_regions_csv
from dvc.trust.uncertainty import Interval
from dvc.trust.verdict import Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """Deformation and strain between the unloaded and one loaded image, with verdict and error bars.

    Everything is on the voxels of the unloaded image, in the reference configuration, LPS mm; NaN where not defined.

    Attributes
    ----------
    name : str
        Name of the load.
    deformation : Deformation
        Displacement of tissue relative to its bone.
    maps : StrainMaps
        Displacement, Green-Lagrange strain, maximum shear strain (E1 - E3)/2, det F, and where they are valid.
    alignment : mapping
        The bone's rigid motion between the scans, as plain values: "on" (what was aligned), "rotation" (3 x 3) and
        "translation_lps_mm" (`bone_motion`), "repeatability_rms_mm" and more.
    quality : Quality
        The figures behind the verdict.
    regions : tuple of RegionRow
        Statistics of maximum shear strain, det F and displacement by region.
    error_bars : ErrorBars
        Bias, standard deviation and intervals of the maximum shear strain, or why there are none.
    image : Image or None
        Image below the maps in figures: the unloaded image, or the registered one if read from a folder.
    source : Source or None
        What it was made from; None if read from a folder.
    shown_mm : (3,) or None
        Point where the slices in figures meet, LPS mm: where the bone is nearest to the plate; None: amid the tissue.
    is_repeat : bool
        Whether it is of a repeat scan, whose strain is the noise floor.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from dvc import Affine, Grid, Image, Mask
    >>> grid = Grid((8, 8, 8), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    >>> values = np.zeros(grid.shape, dtype=np.float32)
    >>> values[2:6, 2:6, 2:6] = 1.0
    >>> subject = Subject(Image(grid, values), tissue=Mask(grid, values > 0))
    >>> stretched = Measurement.from_deformation(Affine(np.diag([1.2, 1.0, 1.0]), np.zeros(3)), subject)
    >>> round(float(np.nanmean(stretched.max_shear)), 3)
    0.11
    >>> with TemporaryDirectory() as folder:
    ...     _ = stretched.write(Path(folder) / "stretched")
    ...     again = Measurement.read(Path(folder) / "stretched")
    >>> again.verdict.words
    'Use with care'
    """

    name: str
    deformation: Deformation
    maps: StrainMaps
    alignment: Mapping[str, object]
    quality: Quality
    regions: tuple[RegionRow, ...]
    error_bars: ErrorBars
    image: Image | None = None
    source: Source | None = None
    shown_mm: FloatArray | None = None
    is_repeat: bool = False

    @classmethod
    def from_registration(
        cls,
        found: Registration,
        subject: Subject,
        evidence: Evidence | None = None,
        *,
        name: str = "load",
        is_repeat: bool = False,
    ) -> Self:
        """Strain, verdict and error bars of a registered pair.

        With ``is_repeat`` the loaded image is a repeat scan without load; its strain is the noise floor.
        """
        more = evidence or Evidence()
        # On two cores, as NumPy, SciPy and compiled loops let go of the interpreter.
        with ThreadPoolExecutor(1) as pool:
            carried = pool.submit(judgement.carried_images, found)
            maps = judgement.maps_of(found)
            bars = NO_ERROR_BARS if is_repeat else error_bars(found, subject, maps, more.error_model, more.twin)
            images = carried.result()
        if is_repeat:
            more = replace(more, noise_floor=noise_floor(maps, subject.soft(found.tissue)))
        quality = judgement.quality_of(found, maps, images.similarity, more, subject)
        alignment = judgement.alignment_of(found)
        regions = tuple(region_statistics(subject.regions(found.tissue), maps.by_quantity))
        source, at = Source(subject, found.tissue, found, images), subject.lowest_bone_point_mm
        figures = found.deformation, maps, alignment, quality, regions, bars, found.reference, source, at, is_repeat
        return cls(name, *figures)

    @classmethod
    def from_deformation(cls, whole: Deformation, subject: Subject, *, name: str = "load") -> Self:
        """Strain of a deformation from another program; no images are compared.

        Parameters
        ----------
        whole : Deformation
            Maps points of the unloaded image to points of the loaded one, LPS mm. If the subject has a bone, its rigid
            motion (least squares over its voxels) is removed.

        Raises
        ------
        InputError
            If it is not defined in the bone.
        """
        (relative, motion), body = without_motion(whole, subject.bone), subject.body()
        maps = strain_maps(relative, body)
        alignment = {"on": "none" if subject.bone is None else "bone", **judgement.motion_as_dict(motion)}
        quality = assess(maps, body, subject.bone, plate_normal=subject.pressed_along)
        bars, source = ErrorBars(None, ""), Source(subject, body)
        regions, at = tuple(region_statistics(subject.regions(body), maps.by_quantity)), subject.lowest_bone_point_mm
        return cls(name, relative, maps, alignment, quality, regions, bars, subject.reference, source, at)

    @classmethod
    def read(cls, folder: Path | str, image: Image | None = None) -> Self:
        """Read the folder of one load that `write` or ``mrstrain register`` wrote.

        Parameters
        ----------
        folder : path
            Folder of one load; a series has one for each load.
        image : Image, optional
            The unloaded image, for figures, which is not in the folder; by default the registered image.

        Raises
        ------
        InputError, ImageFileError
            If a file is missing or damaged, or the folder is that of a series.
        GeometryError
            If the image is on another grid than the maps.
        """
        stored = read_stored(Path(folder), image)
        return cls(
            **{one.name: getattr(stored, one.name) for one in fields(stored)}, is_repeat=stored.name == files.REPEAT
        )

    @property
    def verdict(self) -> Verdict:
        """The verdict on the registration, with its reasons."""
        return self.quality.verdict

    @property
    def max_shear(self) -> Float32Array:
        """Maximum shear strain (E1 - E3)/2 (ni, nj, nk), no unit; NaN where not defined."""
        return self.maps.max_shear

    @property
    def sigma(self) -> Float32Array | None:
        """Standard uncertainty of max_shear - bias (ni, nj, nk), not of max_shear; None without error bars."""
        return self.error_bars.sigma

    @property
    def bias(self) -> Float32Array | None:
        """Expected error of max_shear (ni, nj, nk); None without error bars, or if an older version wrote them."""
        return self.error_bars.bias

    @property
    def intervals(self) -> tuple[Interval, ...]:
        """95 % intervals of percentiles and volumes above a strain, by tissue; empty without error bars."""
        return self.error_bars.intervals

    def draws(self, count: int, *, seed: int = 1) -> Iterator[TrueField]:
        """Draw true fields that agree with what was measured and with its errors, about 1 s each at 128^3 voxels.

        Errors are alike in neighbouring voxels, partly the same in a whole tissue, and in each draw those of one
        registration of the accuracy study. Draws are not widened as `intervals` are: for a statistic of the maximum
        shear strain in a tissue, `ErrorBars.interval_of` makes of them an interval that is.

        Parameters
        ----------
        count : int
            Number of draws, 1 or more.
        seed : int
            Of the random numbers.

        Yields
        ------
        TrueField
            Displacement, Green-Lagrange strain and maximum shear strain on the voxels of the soft tissues.

        Raises
        ------
        InputError
            Without error bars, or if the error model has no components.
        """
        return self.error_bars.draws(self.maps, count, seed)

    @property
    def components(self) -> ComponentUncertainty | None:
        """Standard uncertainty of the components of strain and displacement; None without error bars for them."""
        return self.error_bars.components

    @property
    def bone_motion(self) -> RigidMotion:
        """The bone's motion between the scans, which is removed from the displacement."""
        return files.motion_in(dict(self.alignment))

    @property
    def strain_line(self) -> str:
        """The maximum shear strain by region, with intervals of 95 % coverage where they are known, in a line."""
        rows = (r for r in self.regions if r.quantity == "max_shear" and np.isfinite(r.median))
        each = [f"{r.region} {median} / {high}" for r in rows for median, high in [page.estimates(r, self.intervals)]]
        known = " (95 % interval)" if any(np.isfinite(i.low) for i in self.intervals) else ""
        return f"maximum shear strain (E1 - E3)/2, median / 95th percentile{known}: {', '.join(each)}"

    @property
    def headline(self) -> str:
        """The maximum shear strain of the region with most of it (median times volume), and the verdict, in a line."""
        rows = [r for r in self.regions if r.quantity == "max_shear" and np.isfinite(r.median)]
        if not rows:
            return f"no maximum shear strain; {self.verdict.words}"
        most = max(rows, key=lambda r: r.median * r.volume_ml)
        strain = "{} median, {} at the 95th percentile".format(*page.estimates(most, self.intervals))
        return f"max. shear in {most.region} {strain}; {self.verdict.words}"

    def summary(self) -> list[str]:
        """The verdict with its reasons and the strain, in lines."""
        return [
            f"{self.name}: {self.verdict.words}.",
            *(f"    {reason}" for reason in self.verdict.reasons),
            f"    {self.strain_line}",
            *(f"    {line}" for line in self._of_error_bars),
        ]

    @property
    def _of_error_bars(self) -> list[str]:
        """Why there are no error bars, and what the twin did to them; a repeat scan needs none."""
        return [] if self.is_repeat else self.error_bars.summary

    def __str__(self) -> str:
        return "\n".join(self.summary())

    def plot(
        self,
        quantity: str = "max_shear",
        planes: Sequence[Plane] = PLANES,
        *,
        point_mm: npt.ArrayLike | None = None,
        largest: float | None = None,
    ) -> Figure:
        """Draw a quantity in colour over the unloaded image; thin white lines are the outlines of its labels.

        Parameters
        ----------
        quantity : str
            "max_shear", "sigma", "jacobian", "displacement_mm" (its length), or a component of the Green-Lagrange
            strain: "xx", "xy", "xz", "yy", "yz", "zz".
        planes : sequence of {"sagittal", "coronal", "axial"}
        point_mm : (3,), optional
            Point where the planes meet, LPS mm; by default where the bone is nearest to the plate, or amid the tissue.
        largest : float, optional
            Upper end of the colour scale, in the unit of the quantity; by default just above the 99th percentile.

        Raises
        ------
        InputError
            If the quantity or plane is unknown, or "sigma" is requested without error bars.
        GeometryError
            If the point is outside the image.
        """
        view, values = self._view(point_mm), self._values_of(quantity)
        outline = None if self.source is None else self.source.subject.labels
        scale = Scale.of(quantity, values if quantity == "max_shear" else view.shown(values), largest)
        return coloured(view, self.image, values, scale, planes=planes, outline=outline).finished()

    def _values_of(self, quantity: str) -> Float32Array:
        """A scalar (ni, nj, nk) by its name, NaN where not defined."""
        if quantity in TENSOR_COMPONENTS:
            return self.maps.green_lagrange[..., TENSOR_COMPONENTS.index(quantity)]
        if quantity == "sigma" and self.sigma is None:
            raise InputError("sigma: this measurement has no error bars; `error_bars.explanation` gives the reason.")
        known = self.maps.by_quantity | ({} if self.sigma is None else {"sigma": self.sigma})
        if quantity not in known:
            names = ", ".join((*self.maps.by_quantity, "sigma", *TENSOR_COMPONENTS))
            raise InputError(f"Unknown quantity '{quantity}'; choose one of {names}.")
        return known[quantity]

    def _repr_html_(self) -> str:
        picture = Picture("Maximum shear strain", "", png_bytes(self.plot()))
        table = page.summary_table(self.regions, self.intervals)
        return notebook_html(self.name, picture, table, verdict=self.verdict, notes=self._of_error_bars)

    def section(self, pictures: Mapping[str, Picture]) -> Section:
        """Its part of a report."""
        found, bars = None if self.source is None else self.source.registration, self.error_bars
        weights = [] if found is None or not found.choice.rows() else [page.weights_table(found.choice)]
        engine = "" if found is None else found.settings.engine.note
        made = None if self.source is None else self.source.subject.from_image
        fixed = page.FIXED_WEIGHTS if weights and self.is_repeat else ""
        notes = " ".join(filter(None, [engine, "" if made is None else made.told, fixed, *self._of_error_bars]))
        tables = [replace(page.key_figures(self.quality, self.alignment), note=notes), page.region_table(self.regions)]
        tables += [*([] if self.is_repeat else weights), *page.error_tables(bars)]
        others = [picture for stem, picture in pictures.items() if stem not in ("strain", "curves", "checkerboard")]
        shown = pictures["strain"], pictures["curves"], *others
        short = page.summary_table(self.regions, self.intervals, bars.beyond)
        part = Section(self.name, self.verdict, tuple(tables), shown, pictures_first=True, summary=short)
        return replace(part, caveat=bars.beyond)

    def drawings(self) -> dict[str, Drawing]:
        """The figures of a report, by the name of their files; InputError for one that was read from a folder."""
        of = self._view(), self._made_from(), self.maps, self.quality.noise_floor, self.sigma
        return page.drawings_of(*of, loaded="repeat" if self.is_repeat else "loaded")

    def write(self, folder: Path | str, provenance: Mapping[str, object] | None = None) -> Section:
        """Write everything to a folder, complete or not at all; an older folder of that name is replaced.

        Parameters
        ----------
        folder : path
            The parent folder must exist.
        provenance : mapping, optional
            What it was made from, as plain values; written to ``provenance.json``.

        Returns
        -------
        Section
            The section of a report, with the figures that were written.

        Raises
        ------
        InputError
            For a measurement that was read from a folder; copy that folder instead.
        OutputError
            If it cannot be written.
        """
        made, verdict, bars = self._made_from(), self.verdict, self.error_bars
        told = figures_to_store(self.quality, self.alignment, self.shown_mm, made.registration, bars)
        with whole_folder(Path(folder)) as partial, ThreadPoolExecutor(1) as pool:
            writing = [pool.submit(files.write_maps, partial, self.maps, made.subject.axes, verdict)]
            if (found := made.registration) is not None and made.images is not None:
                writing.append(pool.submit(judgement.write_images_and_transforms, partial, found, made.images))
            if bars.uncertainty is not None:
                sure, grid = bars.uncertainty, self.maps.grid
                writing.append(pool.submit(error_files.write_uncertainty, partial, grid, sure, bars.model, verdict))
            if (mesh := made.subject.mesh) is not None:  # in the same thread, as compiled kernels may not be in two
                onto = pool.submit(files.write_mesh_results, partial, mesh, self.deformation, verdict)
            (place := partial / files.FIGURES).mkdir()
            pictures = {stem: one.save(place / stem) for stem, one in self.drawings().items()}  # while files are made
            write_regions_csv(partial / files.REGIONS, self.regions, verdict)
            for one in writing:
                one.result()
            if mesh is not None:
                told["mesh"] = onto.result()
            write_json(partial / files.QUALITY, told)
            if provenance is not None:
                write_json(partial / files.PROVENANCE, provenance)
        return self.section(pictures)

    def _made_from(self) -> Source:
        if self.source is None:
            raise InputError(
                f"The measurement {self.name} was read from a folder, so it has no images to draw or write. Copy the "
                "folder instead."
            )
        return self.source

    def _view(self, point_mm: npt.ArrayLike | None = None) -> View:
        """The slices through a point, through the bone's nearest to the plate, or through the tissue's middle."""
        return View.through(self.maps.grid, self.shown_mm if point_mm is None else point_mm, self.maps.valid)
