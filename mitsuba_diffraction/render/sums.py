"""Sums over the passes of a picture, the standard error of their mean, and their checkpoints.

A checkpoint is a header of fixed size (its own SHA-256, the digest of the request, `Job.digest`, and the number of
passes), and the arrays of `Accumulation`, uncompressed, as noise does not compress. Their shapes and types follow from
the request. It takes 4 bytes per pixel and channel, and twice as much while it is being replaced.

To bound memory, a large picture is traced in bands of rows (`trace_pass.bands_of`): in each pass, band after band is
added to its sums. One band is in memory, the others are in checkpoints of their own.
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
import sys
import tempfile
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files.reading import check_file
from ..files.writing import UNSEALED, discard, is_intact, seal, whole_file
from ..optics.color import radiance_to_XYZ
from ..settings import VISIBLE
from .spectral_film import SpectralRange, channel_wavelengths
from .spectral_image import SpectralImage, split_rows
from .trace_pass import Rows


@dataclass(eq=False)
class Accumulation:
    """Sums over passes p = 1 … P of n_p samples per pixel each.

    y_p is the luminance Y of a pixel in pass p alone, of invisible light its mean radiance. Floating-point sums depend
    on their order: passes must be added in the order of their indices.

    Attributes:
        sums: (height, width, n + 1) float32, or n + 2 with alpha: Σ_p of the results of `trace_pass`, at
            `channel_wavelengths(spectral_range)`.
        luminance: (height, width) float64, Σ_p n_p y_p.
        squares: (height, width) float64, Σ_p n_p y_p².
        passes: P.
        samples: N = Σ_p n_p.
        spectral_range: (shortest, longest) wavelength, nm.
    """

    sums: NDArray[np.float64]
    luminance: NDArray[np.float64]
    squares: NDArray[np.float64]
    passes: int = 0
    samples: int = 0
    spectral_range: SpectralRange = VISIBLE

    @classmethod
    def empty(
        cls, rows: int, columns: int, alpha: bool = False, spectral_range: SpectralRange = VISIBLE
    ) -> Accumulation:
        """Return the sums of zero passes."""
        channels = channel_wavelengths(spectral_range).size + (2 if alpha else 1)
        luminance, squares = np.zeros((2, rows, columns))
        return cls(np.zeros((rows, columns, channels), np.float32), luminance, squares, spectral_range=spectral_range)

    def arrays(self) -> tuple[NDArray, ...]:
        """Return the arrays, in the order of a checkpoint."""
        return self.sums, self.luminance, self.squares

    def add(self, traced: NDArray[np.float32], samples: int) -> None:
        """Add the result of `trace_pass` with that many samples per pixel."""
        wavelengths = channel_wavelengths(self.spectral_range)
        weights = radiance_to_XYZ(np.eye(wavelengths.size), wavelengths)[:, 1]
        # einsum adds in an order that depends on the layout alone, which differs between machines of a cluster; a
        # matrix product may be multithreaded.
        rows = (np.ascontiguousarray(row[:, : weights.size], np.float64) for row in traced)
        luminance = np.stack([np.einsum("xi,i->x", row, weights) for row in rows])
        luminance = ratio(luminance, traced[..., -1])
        self.sums += traced
        self.luminance += samples * luminance
        self.squares += samples * luminance**2
        self.passes += 1
        self.samples += samples

    def radiance(self, rows: slice = slice(None)) -> NDArray[np.float32]:
        """Return the radiance, (height, width, n) float32, W m⁻² sr⁻¹ nm⁻¹."""
        n = channel_wavelengths(self.spectral_range).size
        return ratio(self.sums[rows, :, :n], self.sums[rows, :, -1:])

    def alpha(self) -> NDArray[np.float32]:
        """Return the fraction of valid samples, (height, width), 0 to 1; only of sums with alpha."""
        return np.clip(ratio(self.sums[..., -2], self.sums[..., -1]), 0, 1)

    def relative_errors(self) -> NDArray[np.float32]:
        """Return the relative standard error of luminance, (height, width); NaN if black or before two passes.

        With σ² the variance of the luminance of a sample, y_p has the variance σ²/n_p. An unbiased estimate of σ² is

            s² = (Σ_p n_p y_p² − (Σ_p n_p y_p)²/N) / (P − 1),

        and the relative error of a pixel is (s/√N) / (Σ_p n_p y_p/N).
        """
        errors = np.full(self.luminance.shape, np.nan, np.float32)
        if self.passes >= 2:
            lit = self.luminance > 0
            luminance, squares = self.luminance[lit], self.squares[lit]
            variance = np.maximum(squares - luminance**2 / self.samples, 0) / (self.passes - 1)
            errors[lit] = np.sqrt(variance * self.samples) / luminance
        return errors


def error_of_picture(errors: NDArray[np.float32]) -> float:
    """Return the 90th percentile of `Accumulation.relative_errors` over all non-black pixels; NaN if all are black.

    The mean square over all pixels is not used: where a lamp is seen via two gratings it is dominated by fireflies, and
    does not decrease for hours. With few passes the percentile is biased upwards by the variance of s².
    """
    errors = errors[~np.isnan(errors)]
    return float(np.percentile(errors, 90)) if errors.size else math.nan


def ratio(sums: NDArray, weights: NDArray) -> NDArray:
    """Return sums/weights, zero where there are no samples under the filter."""
    return np.divide(sums, weights, out=np.zeros_like(sums), where=weights != 0)


def checkpoint_path(picture: Path) -> Path:
    """Return the path of the checkpoint of a picture, next to it."""
    return picture.with_name(f"{picture.name}.checkpoint")


def checkpoint_of_band(checkpoint: str | os.PathLike[str], index: int) -> str:
    """Return the path of the checkpoint of a band; the path of the first has no number."""
    return f"{os.fspath(checkpoint)}.{index}" if index else os.fspath(checkpoint)


def discard_checkpoints(checkpoint: str | os.PathLike[str]) -> None:
    """Remove the checkpoints of all bands of a picture."""
    numbers = itertools.count(1)
    others = itertools.takewhile(os.path.exists, (checkpoint_of_band(checkpoint, number) for number in numbers))
    for path in (*others, checkpoint):
        discard(path)


_TITLE = "mitsuba_diffraction checkpoint"
_HEADER = f"{_TITLE}\n{UNSEALED}\n{{digest:64}}\n{{passes:7}}\n"
_HEADER_BYTES = len(_HEADER.format(digest="", passes=0))


def save_checkpoint(path: str | os.PathLike[str], digest: str, sums: Accumulation) -> None:
    """Write a checkpoint atomically: after a kill, a power cut or an OSError, `path` is the old or the new one."""
    with whole_file(path) as temporary:
        with open(temporary, "wb") as stream:
            stream.write(_HEADER.format(digest=digest, passes=sums.passes).encode())
            for array in sums.arrays():
                stream.write(array.data)
        seal(temporary)


def load_checkpoint(path: str | os.PathLike[str], digest: str, sums: Accumulation, samples: tuple[int, ...]) -> None:
    """Read the checkpoint of a request with this digest, if there is such a file.

    Args:
        sums: of zero passes, with the shapes of the request; they are filled.
        samples: per pixel, in each pass of the request.

    Raises:
        ValueError: if it is damaged, not a checkpoint, or one of another request.
    """
    name = os.fspath(path)
    if not os.path.exists(path):
        return
    check_file(path, sys.maxsize)
    with open(path, "rb") as stream:
        lines = stream.read(_HEADER_BYTES).split(b"\n")
        if lines[0] != _TITLE.encode() or not is_intact(path):
            raise RequestError(f"{name}: not a checkpoint, or a damaged one")
        if lines[2] != digest.encode():
            raise RequestError(
                f"{name}: of another rendering: the scene or a file that it references, an option or a version has "
                "changed; repeat the original command, or remove the file to start over"
            )
        passes = int(lines[3]) if lines[3].strip().isdigit() else -1
        sizes = [array.nbytes for array in sums.arrays()]
        if not 0 <= passes <= len(samples) or os.path.getsize(path) != _HEADER_BYTES + sum(sizes):
            raise RequestError(f"{name}: sums of {passes} passes that do not suit the request; remove it to start over")
        for array in sums.arrays():
            stream.readinto(array.data.cast("B"))
    sums.passes, sums.samples = passes, sum(samples[:passes])


class BandedSums:
    """The sums of a picture in bands of rows: one band is in memory, all others are in checkpoints.

    Attributes:
        bands: rows of each band.
        samples: per pixel, in each pass.
        done: number of additions so far: in each pass, one per band from top to bottom.
        errors: (height, width) float32, `Accumulation.relative_errors`.
        luminance: (height, width) float32, mean luminance.
        alpha: (height, width) float32, or None.
    """

    def __init__(
        self,
        bands: tuple[Rows, ...],
        samples: tuple[int, ...],
        columns: int,
        digest: str,
        checkpoint: str | os.PathLike[str] | None,
        alpha: bool = False,
        spectral_range: SpectralRange = VISIBLE,
    ) -> None:
        """Read existing checkpoints (errors: see `load_checkpoint`); without `checkpoint` they are temporary files."""
        self.bands, self.samples, self.spectral_range = bands, samples, spectral_range
        self._columns, self._digest = columns, digest
        if checkpoint is None and len(bands) > 1:
            checkpoint = Path(tempfile.mkdtemp(), "sums")
            weakref.finalize(self, shutil.rmtree, checkpoint.parent, ignore_errors=True)
        self._paths = [None] if checkpoint is None else [checkpoint_of_band(checkpoint, k) for k in range(len(bands))]
        self.errors, self.luminance = np.full((2, bands[-1][1], columns), np.nan, np.float32)
        self.alpha = np.zeros((bands[-1][1], columns), np.float32) if alpha else None
        self._index, self._saved = -1, 0
        passes = [self._describe(index).passes for index in range(len(bands))]
        self.done = sum(passes)
        if passes != [-(-(self.done - index) // len(bands)) for index in range(len(bands))]:
            raise RequestError(f"{checkpoint}: a checkpoint of another band is missing; remove them to start over")

    def band(self, index: int) -> Accumulation:
        """Return the sums of a band, after saving the sums that were in memory."""
        if index != self._index:
            self.release()
            (first, end), path = self.bands[index], self._paths[index]
            self._sums = Accumulation.empty(end - first, self._columns, self.alpha is not None, self.spectral_range)
            if path is not None:
                load_checkpoint(path, self._digest, self._sums, self.samples)
            self._index, self._saved = index, self._sums.samples
        return self._sums

    def add(self, traced: NDArray[np.float32]) -> None:
        """Add the next result of `trace_pass`."""
        number, index = divmod(self.done, len(self.bands))
        self.band(index).add(traced, self.samples[number])
        self._describe(index)
        self.done += 1

    def release(self) -> None:
        """Free the memory of the sums, after saving them."""
        self.save()
        self._index, self._sums = -1, Accumulation.empty(0, 0)

    def save(self) -> None:
        """Write the checkpoint of the sums in memory, if there is anything new in them."""
        if self._index < 0 or (path := self._paths[self._index]) is None or self._saved == self._sums.samples:
            return
        try:
            save_checkpoint(path, self._digest, self._sums)
        except OSError as error:
            kept = f"the last one, of {self._saved} samples per pixel, is kept" if self._saved else "there is none yet"
            raise OSError(f"{os.fspath(path)}: cannot be written ({error.strerror or error}); {kept}") from error
        self._saved = self._sums.samples

    def _describe(self, index: int) -> Accumulation:
        """Update errors and luminance of a band, and return its sums."""
        sums, rows = self.band(index), slice(*self.bands[index])
        self.errors[rows] = sums.relative_errors()
        self.luminance[rows] = sums.luminance / max(sums.samples, 1)
        if self.alpha is not None:
            self.alpha[rows] = sums.alpha()
        return sums


class BandedImage(SpectralImage):
    """A picture kept as sums; one band is in memory at a time. Reading `radiance` loads all of it."""

    _sums: BandedSums

    def __init__(self, sums: BandedSums, attributes: Mapping[str, str | int | float]) -> None:
        object.__setattr__(self, "wavelengths", channel_wavelengths(sums.spectral_range))
        object.__setattr__(self, "attributes", dict(attributes))
        object.__setattr__(self, "alpha", sums.alpha)
        object.__setattr__(self, "_sums", sums)

    @property
    def shape(self) -> tuple[int, int, int]:
        return (*self._sums.luminance.shape, self.wavelengths.size)

    def blocks(self) -> Iterator[NDArray[np.float32]]:
        for index in range(len(self._sums.bands)):
            sums = self._sums.band(index)
            for rows in split_rows(*sums.luminance.shape):
                yield sums.radiance(rows)
            del sums
        if len(self._sums.bands) > 1:
            self._sums.release()

    @cached_property
    def radiance(self) -> NDArray[np.float32]:
        radiance = np.empty(self.shape, np.float32)
        row = 0
        for block in self.blocks():
            radiance[row : row + len(block)] = block
            row += len(block)
        radiance.setflags(write=False)
        return radiance
