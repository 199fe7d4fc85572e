"""Voxels as they lie in a file: where they start, how they are coded, and reading them with every check.

Libraries often return whatever a damaged file holds. Here the number of bytes is compared with the header, and
compressed streams are read to their end, so that their checksum counts.
"""

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dvc.arrays import FloatArray
from dvc.errors import GeometryError, ImageFileError
from dvc.images.image import Grid

MAX_BYTES = 16 * 2**30
"""Largest image that is read by default, counted as single precision."""

_BLOCK = 1 << 20
_TRAILING = 4096  # some writers pad the end of a file
_DEFLATE_LIMIT = 1100  # deflate cannot expand by more than about 1032
_ORTHONORMAL = 1e-4

Voxels = npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class StoredVolume:
    """One volume of a file, described by its header and not yet read."""

    path: Path  # of the file that holds the voxels
    grid: Grid  # LPS mm, whatever the unit of the file
    dtype: np.dtype[Any]  # as stored, with byte order
    layout: tuple[int, ...]  # sizes, fastest first; three, or four where each voxel holds several values
    unit: str = "mm"  # of length, as the header names it
    file_start: int = 0  # bytes of the file before the stream of voxels
    compressed: bool = False  # gzip or zlib
    stream_start: int = 0  # bytes of the (expanded) stream before this volume
    stream_rest: int = 0  # bytes of the (expanded) stream after this volume, which must be there too
    slope: float = 1.0  # value = slope * stored + intercept
    intercept: float = 0.0
    select: tuple[int, int] | None = None  # (axis, index) of ``layout`` to keep, where it has four
    components: int | None = None  # axis of ``layout`` along which a vector's components lie, where they are kept

    def load(self) -> Voxels:
        """Voxels (ni, nj, nk), or vectors (ni, nj, nk, 3), in the stored number type where no scaling applies."""
        values = self._bytes().view(self.dtype).reshape(self.layout, order="F")
        if self.select is not None:
            values = values.take(self.select[1], axis=self.select[0])
        if self.components is not None:
            values = np.moveaxis(values, self.components, -1)
        if (self.slope, self.intercept) == (1.0, 0.0):
            return values
        # Up to 16 bits survive single precision; wider integers are scaled in double.
        narrow = self.dtype.itemsize <= 2 or self.dtype == np.dtype(np.float32)
        scaled: Voxels = values.astype(np.float32 if narrow else np.float64)
        scaled *= self.slope
        scaled += self.intercept
        return scaled

    def _bytes(self) -> npt.NDArray[np.uint8]:
        size = int(np.prod(self.layout, dtype=object)) * self.dtype.itemsize
        expected = self.stream_start + size + self.stream_rest
        on_disk = self.path.stat().st_size - self.file_start
        most = on_disk * _DEFLATE_LIMIT if self.compressed else on_disk
        if most < expected:
            raise self._cut_short(expected, on_disk, " compressed" if self.compressed else "")
        raw = np.empty(size, dtype=np.uint8)
        if not self.compressed:
            with self.path.open("rb") as file:
                file.seek(self.file_start + self.stream_start)
                got = self.stream_start + file.readinto(raw.data) + self.stream_rest
            available = max(on_disk, got) if got == expected else got
        else:
            available = 0
            for block in expanded(self.path, self.file_start):
                low = max(self.stream_start - available, 0)
                high = min(self.stream_start + raw.size - available, len(block))
                if low < high:
                    at = available + low - self.stream_start
                    raw[at : at + high - low] = np.frombuffer(block, np.uint8)[low:high]
                available += len(block)
        if available < expected:
            raise self._cut_short(expected, available)
        if available > expected + _TRAILING:
            raise ImageFileError(
                f"{self.path}: the header describes {expected} bytes of voxels, but the file has {available}. "
                "Header and voxels do not match. Export the image again."
            )
        return raw

    def _cut_short(self, expected: int, available: int, coded: str = "") -> ImageFileError:
        return ImageFileError(
            f"{self.path}: the file is incomplete: the header needs {expected} bytes of voxels, but the file has "
            f"{available}{coded} bytes. Copy or export it again."
        )


def expanded(path: Path, start: int = 0) -> Iterator[bytes]:
    """Blocks of the gzip or zlib stream at byte `start` of a file, to its end and checksum; refused if damaged."""
    with path.open("rb") as file:
        file.seek(start)
        decoder = zlib.decompressobj(wbits=47)  # 47: gzip or zlib, told apart by their first bytes
        pending = file.read(_BLOCK)
        while True:
            try:
                block = decoder.decompress(pending, _BLOCK)
            except zlib.error as error:
                problem = f"the compressed voxels are damaged ({error})"
                raise ImageFileError(f"{path}: {problem}. Copy or export the file again.") from error
            if block:
                yield block
            if decoder.eof:
                # gzip files may be several streams in a row, and padded with zeros.
                pending = decoder.unused_data.lstrip(b"\0")
                while not pending:
                    if not (more := file.read(_BLOCK)):
                        return
                    pending = more.lstrip(b"\0")
                decoder = zlib.decompressobj(wbits=47)
                continue
            pending = decoder.unconsumed_tail or file.read(_BLOCK)
            if not pending and not block:
                problem = "the file is incomplete: its compressed data end too early"
                raise ImageFileError(f"{path}: {problem}. Copy or export it again.")


def grid_of_axes(
    path: Path, shape: Sequence[int], columns: FloatArray, origin: FloatArray, *, single_precision: bool = False
) -> Grid:
    """The grid with these steps along its axes, (3, 3) by columns, and origin, LPS mm."""
    with np.errstate(over="ignore"):
        spacing = np.linalg.norm(columns, axis=0)
    if not np.isfinite(spacing).all() or np.any(spacing <= 0):
        raise ImageFileError(
            f"{path}: the header's voxel sizes are {spacing.tolist()} mm; all must be positive. Export it again."
        )
    direction = columns / spacing
    if single_precision:
        left, stretch, right = np.linalg.svd(direction)
        direction = left @ right if np.abs(stretch - 1.0).max() < _ORTHONORMAL / 2 else direction
    try:
        return Grid((shape[0], shape[1], shape[2]), spacing, origin, direction)
    except GeometryError as error:
        raise ImageFileError(f"{path}: {error}") from error


def refuse_if_too_large(path: Path, shape: tuple[int, ...], max_bytes: int) -> None:
    """Refuse an image that takes more than `max_bytes` in single precision, or has a size that is not positive."""
    sizes = [int(n) for n in shape]
    if min(sizes) < 1:
        raise ImageFileError(
            f"{path}: the header gives the image sizes {sizes}; all must be positive. Export it again."
        )
    estimate = 4 * int(np.prod(sizes, dtype=object))
    if estimate > max_bytes:
        raise ImageFileError(
            f"{path}: the header claims {' x '.join(map(str, sizes))} voxels, about {estimate / 2**30:,.1f} "
            f"GiB in single precision; the limit is {max_bytes / 2**30:,.1f} GiB. Crop or resample the image first, or "
            "export it again if the header is damaged."
        )


def pick_volume(path: Path, count: int, volume: int | None) -> int:
    """Which of `count` volumes to read: the one asked for, or the only one."""
    if volume is None:
        if count == 1:
            return 0
        raise ImageFileError(
            f"{path}: the file contains {count} volumes; one is needed. Write it to a file of its own, in Python: "
            f'dvc.write_image("one.nii.gz", dvc.read_image("{path}", volume=N)), with N from 0 to {count - 1}.'
        )
    if not 0 <= volume < count:
        raise ImageFileError(f"{path}: volume={volume} does not exist; the file has volumes 0 to {count - 1}.")
    return volume
