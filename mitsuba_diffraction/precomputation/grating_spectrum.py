"""A power spectrum with the table that bounds its albedo, and its file.

The file is OpenEXR: float32, ZIP, one part, one pixel per diffraction order or node.

Channels are named after what they hold: `S(012.2)` is the coefficient of t² on interval 12 of κ. Those of a series of
the amplitude are `F{u^003}.re` and `.im` (taylor) or `F{T_003}.re` (chebyshev), F_n with u = h/`heightScale`. Rows are
orders m_y, columns m_x, from −M to M. Numbers in the header are double precision. `energy` and `waves` are
JSON: the table of `energy/table.py`, and the roughness by period (`scalar_theory.Waves`). `contentSha256` covers every
byte of the file and reveals damage.
"""

from __future__ import annotations

import json
import os
import threading
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..energy.table import EnergyTable
from ..errors import RequestError
from ..progress import stage
from ..scalar_theory.validity import Waves
from ..settings import REPRESENTATIONS, ScalarSettings
from ..spectrum.exr import MALFORMED, doubles, one_line, read_channels, write_channels
from ..spectrum.grids import OrderGrid, SplineGrid
from ..spectrum.power_spectrum import PowerSpectrum
from ..spectrum.tables import AmplitudeTable, SliceTable

SCALAR_FORMAT = "mitsuba_diffraction grating spectrum"
SCALAR_FORMAT_VERSION = 10

# Attributes and their names in files.
_NUMBERS = {
    "coherence_length": "coherenceLength",
    "largest_angle": "largestAngle",
    "tolerance": "tolerance",
    "height_range": "heightRange",
    "error": "error",
    "truncated_power": "dropped",
    "unresolved_power": "beyond",
}
_OTHERS = {"patches": "patches", "source": "source", "source_digest": "sourceSha256"}

_energy_lock = threading.Lock()


@dataclass(frozen=True, eq=False)
class GratingSpectrum(PowerSpectrum):
    """A power spectrum, the factor E that bounds the albedo by one, and its file.

    Attributes:
        energy: the table of E, if read from the file; otherwise `energy_table` computes it.
        cache: the file of the cache, and the digest of its recipe; `energy_table` adds E to it.
        waves: the waves of a recipe's surface, from which the error of scalar theory is estimated.
    """

    theory: ClassVar[str] = "scalar"

    energy: EnergyTable | None = field(default=None, repr=False)
    cache: tuple[Path, str] | None = field(default=None, repr=False)
    waves: Waves | None = field(default=None, repr=False)

    @property
    def warning(self) -> str:
        """A sentence if scalar theory is inaccurate in light of the wavelengths of the spectrum, otherwise ""."""
        return "" if self.waves is None else self.waves.error(self.wavelengths).warning

    @property
    def concerns(self) -> list[str]:
        """Sentences on errors of the spectrum that exceed what was requested or can be trusted."""
        return list(filter(None, [self.excess, self.warning]))

    @property
    def summary(self) -> str:
        """Its error."""
        scatter = "" if self.standard_error is None else f", standard error of one scan {self.standard_error:.2g}"
        return f"error {self.error:.1e} (tolerance {self.tolerance:.3g}){scatter}"

    @property
    def details(self) -> str:
        """The table, and what it leaves out."""
        return (
            f"{self.representation}; truncated, at most: {self.truncated_power:.1e} of the power at weak frequencies; "
            f"{self.unresolved_power:.1e} at frequencies that no direction reaches or no pixel resolves"
        )

    def energy_table(self) -> EnergyTable:
        """Return the table of E, which bounds the albedo by one; computed at the first call unless read from a file."""
        with _energy_lock:
            return self._energy

    @cached_property
    def _energy(self) -> EnergyTable:
        if self.energy is not None:
            return self.energy
        with stage("bound of the albedo"):
            table = EnergyTable.of(self)
        if self.cache is not None:
            # Without E, an entry is as good: E is computed again.
            with suppress(RequestError, OSError, RuntimeError):
                entry = GratingSpectrum.load(*self.cache)
                if entry.cache is not None and entry.digest == self.digest:  # not of a copy with another table
                    replace(entry, energy=table).save(*self.cache)
        return table

    def up_to(self, longest: float) -> GratingSpectrum:
        """Return the spectrum for wavelengths up to `longest`, nm; the table, for κ from zero, holds for all of them.

        Only E and the samplers depend on the longest wavelength.
        """
        if longest <= self.wavelengths[1] * (1 + 1e-6):
            return self
        settings = replace(self.settings, wavelengths=(self.wavelengths[0], longest))
        return replace(self, settings=settings, energy=None, cache=None)

    def save(self, path: str | os.PathLike[str], recipe: str = "") -> None:
        """Write the spectrum as an OpenEXR file, atomically; `recipe` is the digest of its `Recipe`.

        Files have E, which takes up to thirty times as long as S; that of the cache, once a BSDF has used it.

        Raises:
            OSError: if the file cannot be written.
        """
        grid, table = self.grid, self.table
        energy = self.energy if (path, recipe) == self.cache else self.energy_table()
        header: dict[str, Any] = {
            "representation": self.representation,
            "extent": self.extent,
            "wavelengths": doubles(*self.wavelengths),
            "pixelSize": doubles(*self.pixel_size),
            **(
                {"tileSize": doubles(*grid.tile_size)}
                if isinstance(grid, OrderGrid)
                else {"spacing": doubles(*grid.spacing), "limit": doubles(*grid.limit)}
            ),
            **{key: doubles(getattr(self, name)) for name, key in _NUMBERS.items()},
            **{key: getattr(self, name) for name, key in _OTHERS.items()},
            **({} if self.standard_error is None else {"standardError": doubles(self.standard_error)}),
            "units": "lengths in micrometres, wavelengths in nanometres",
            **({} if self.waves is None else {"waves": json.dumps(self.waves.as_plain())}),
            **({} if energy is None else {"energy": json.dumps(energy.as_plain())}),
        }
        if isinstance(table, AmplitudeTable):
            header |= {"heightScale": doubles(table.height), "heightsFrom": self.settings.heights_from}
        channels = _channels(table)
        header["channelCount"] = len(channels)
        write_channels(path, SCALAR_FORMAT, SCALAR_FORMAT_VERSION, header, channels, recipe)

    @classmethod
    def load(cls, path: str | os.PathLike[str], recipe: str | None = None) -> GratingSpectrum:
        """Read a spectrum that `save` wrote; `recipe` is the digest of the one from which it must have been built.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not a spectrum, is damaged (even by a single bit), has an unknown version or
                representation, or was not built from that recipe.
        """
        path = Path(path)
        header, channels = read_channels(path, SCALAR_FORMAT, SCALAR_FORMAT_VERSION, recipe)
        if (got := header.get("representation")) not in REPRESENTATIONS[1:]:
            raise RequestError(f"{path}: got representation {got!r}, wanted one of {', '.join(REPRESENTATIONS[1:])}")
        try:
            pixels = {name: channel.pixels for name, channel in channels.items()}
            if halves := [name for name, values in pixels.items() if values.dtype != np.float32]:
                raise RequestError(f"{halves[0]} is not of type float")
            table = _table(header, pixels, 4 * np.pi / (_pair(header["wavelengths"])[0] * 1e-3))
            names = _channels(table).keys()
            if pixels.keys() != names or len(names) != header["channelCount"]:
                unknown = ", ".join(sorted(pixels.keys() - names)) or "none unknown"
                raise RequestError(
                    f"got {len(pixels)} channels ({unknown}), wanted {header['channelCount']} of known names"
                )
            series: dict[str, Any] = {}
            if isinstance(table, AmplitudeTable):
                series = {"terms": header["channelCount"] // 2, "heights_from": header["heightsFrom"]}
            entries: dict[str, Any] = {name: header[key] for name, key in _OTHERS.items()}
            entries |= {name: _single(header[key]) for name, key in _NUMBERS.items()}
            settings = ScalarSettings(
                extent=header["extent"],
                wavelengths=_pair(header["wavelengths"]),
                representation=header["representation"],
                **{name: entries.pop(name) for name in ("coherence_length", "largest_angle", "tolerance")},
                **series,
            )
            spectrum = cls(
                table=table,
                grid=_grid(header, table.shape),
                settings=settings,
                pixel_size=_pair(header["pixelSize"]),
                **entries,
                standard_error=_single(header["standardError"]) if settings.extent == "sample" else None,
                energy=EnergyTable.from_plain(json.loads(header["energy"])) if "energy" in header else None,
                cache=None if recipe is None or "energy" in header else (path, recipe),
                waves=Waves.from_plain(json.loads(header["waves"])) if "waves" in header else None,
            )
            spectrum.check_powers()
            return spectrum
        except KeyError as error:
            raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
        except MALFORMED as error:
            raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _grid(header: dict, shape: tuple[int, int]) -> OrderGrid | SplineGrid:
    max_order = ((shape[1] - 1) // 2, (shape[0] - 1) // 2)
    if "tileSize" in header:
        return OrderGrid(_pair(header["tileSize"]), max_order)
    return SplineGrid(_pair(header["spacing"]), max_order, _pair(header["limit"]))


_FUNCTIONS = {"taylor": "F{{u^{:03d}}}", "chebyshev": "F{{T_{:03d}}}"}


def _channels(table: SliceTable | AmplitudeTable) -> dict[str, np.ndarray]:
    if isinstance(table, SliceTable):
        return {f"S({k:03d}.{p})": table.values[k, p] for k, p in np.ndindex(table.intervals, table.terms)}
    names = [_FUNCTIONS[table.representation].format(n) for n in range(len(table.terms))]
    parts = (("re", table.terms.real), ("im", table.terms.imag))
    return {f"{name}.{part}": np.ascontiguousarray(v) for part, vs in parts for name, v in zip(names, vs, strict=True)}


def _table(header: dict, pixels: dict[str, np.ndarray], max_kappa: float) -> SliceTable | AmplitudeTable:
    kind, count = header["representation"], min(header["channelCount"], len(pixels))  # which the caller compares
    if kind == SliceTable.representation:
        terms = 4 if "S(000.3)" in pixels else 3
        values = [[pixels[f"S({k:03d}.{p})"] for p in range(terms)] for k in range(count // terms)]
        return SliceTable(max_kappa, np.array(values, np.float32))
    names = [_FUNCTIONS[kind].format(n) for n in range(count // 2)]
    parts = np.stack([[pixels[f"{name}.{part}"] for name in names] for part in ("re", "im")], axis=-1)
    return AmplitudeTable(kind, max_kappa, _single(header["heightScale"]), parts.view(np.complex64)[..., 0])


def _single(value: np.ndarray) -> float:
    if not isinstance(value, np.ndarray) or value.shape != (1,):
        raise RequestError(f"got {value!r}, wanted one double")
    return float(value[0])


def _pair(value: np.ndarray) -> tuple[float, float]:
    x, y = (float(v) for v in value)
    return x, y
