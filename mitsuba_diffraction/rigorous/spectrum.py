"""Rigorous efficiencies of a grating as a table over direction and wavelength, and its file.

A rigorous spectrum as an OpenEXR file: float32, ZIP, one part.

Channel `eta(07)` holds plane 7 of the table (`Axes`): the squares [P, R] of the orders −M … M from top to bottom, each
at the left; below them, if the table is polarised, the Mueller matrices of this plane, one after the other. Numbers in
the header are double precision.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..settings import lobe_reach, lobe_width
from ..spectrum.exr import doubles, one_line, read, write
from ..spectrum.orders import OrderGrid
from .axes import Axes

Real = NDArray[np.float64]

FORMAT = "mitsuba_diffraction rigorous spectrum"
FORMAT_VERSION = 2

_NUMBERS = ("ext_ior", "coherence_length", "tolerance", "error", "worst", "worst_near", "polarisation_error")
_TEXTS = ("material", "source", "source_digest")


@dataclass(frozen=True, eq=False)
class RigorousSpectrum:
    """η_m of unpolarised light, over `Axes`, and what else a BSDF needs: f = Σ_m η_m N(q − m/T; σ_q² I) / λ².

    Attributes:
        axes: what the table stands over.
        values: (K, nodes) float32, η at the nodes of `axes`; of order m, side² values from offset(m), [P, R].
        material: a conductor by Mitsuba's name, or "" for a dielectric.
        int_ior: n + ik if there is no material.
        coherence_length: L_c in µm; it sets the width σ_q of each order.
        tolerance: what was asked for.
        error: what was measured at directions (uniform over the hemisphere) and wavelengths that were not used to build
            the table: the mean of Σ|Δη_m| / Σ η_m.
        worst: the largest of these, away from the lines where an order passes off (P or R within 0.02 of an integer).
        worst_near: the largest of these near such a line.
        harmonics: N of the solver.
        source: where the heights came from.
        source_digest: SHA-256 of the height field.
        ext_ior: index of the medium above relative to air; wavelengths are those in this medium.
        mueller: (K, nodes, 4, 4) float32, the Mueller matrices of the orders for k_y ≥ 0, between
            waves in (ê, k̂ × ê), ê the direction of ŷ − (ŷ·k̂)k̂; or None.
        polarisation_error: of `mueller`, as `error`: the mean of Σ_m max_ij |ΔM_ij| / Σ η_m; NaN if there is none.
    """

    axes: Axes
    values: NDArray[np.float32]
    material: str
    int_ior: complex
    coherence_length: float
    tolerance: float
    error: float
    worst: float
    worst_near: float
    harmonics: int
    source: str
    source_digest: str = field(repr=False)
    ext_ior: float = 1.0
    mueller: NDArray[np.float32] | None = field(default=None, repr=False)
    polarisation_error: float = float("nan")

    def __post_init__(self) -> None:
        wanted = self.axes.planes, self.axes.nodes
        if self.values.shape != wanted or self.values.dtype != np.float32:
            raise RequestError(f"values: got {self.values.shape} of {self.values.dtype}, wanted {wanted} of float32")
        if self.mueller is not None:
            matrices = (*wanted, 4, 4)
            if self.mueller.shape != matrices or self.mueller.dtype != np.float32:
                raise RequestError(f"mueller: got {self.mueller.shape}, wanted {matrices} of float32")
        lobe_width(self.coherence_length)

    # As a `GratingSpectrum` has them.
    extent = "tile"
    representation = "rigorous"
    largest_angle = 90.0

    @property
    def wavelengths(self) -> tuple[float, float]:
        """(shortest, longest) in nm."""
        shortest, longest = (1e3 * w for w in self.axes.wavelengths)
        return shortest, longest

    @property
    def grid(self) -> OrderGrid:
        """The orders m that any pair of directions reaches."""
        return OrderGrid((self.axes.period, self.axes.period), (self.axes.largest, 0))

    @property
    def material_name(self) -> str:
        """As recipes and scenes give it."""
        medium = "" if self.ext_ior == 1 else f" below ext_ior {self.ext_ior:.6g}"
        if self.material:
            return f"material {self.material}{medium}"
        index = self.int_ior.real if np.imag(self.int_ior) == 0 else self.int_ior
        return f"int_ior {index:.6g}{medium}"

    @property
    def megabytes(self) -> float:
        """Size of the table in memory."""
        return (self.values.nbytes + (0 if self.mueller is None else self.mueller.nbytes)) / 1e6

    @property
    def lobe_width(self) -> float:
        """σ_q in cycles/µm."""
        return lobe_width(self.coherence_length)

    @property
    def reach(self) -> float:
        """How far the lobe of an order is followed, in standard deviations σ_q: a tenth of the tolerance is beyond."""
        return lobe_reach(0.1 * self.tolerance)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of what a renderer needs of it: spectra that have one show the same."""
        told = repr((self.axes, self.material, self.int_ior, self.coherence_length, self.tolerance, self.ext_ior))
        matrices = b"" if self.mueller is None else self.mueller.tobytes()
        return hashlib.sha256(told.encode() + self.values.tobytes() + matrices).hexdigest()

    def evaluate(self, m: ArrayLike, c: ArrayLike, g: ArrayLike, wavelength: ArrayLike) -> Real:
        """η_m from the table, linear between its nodes.

        Args:
            m: orders, broadcast against the others.
            c, g: as in `Axes`.
            wavelength: µm.

        Returns:
            η_m; 0 for an order that does not propagate, or that is beyond the wavelengths of the table.
        """
        return self._interpolated(self.values, m, c, g, wavelength)

    def evaluate_mueller(self, m: ArrayLike, c: ArrayLike, g: ArrayLike, wavelength: ArrayLike) -> Real:
        """M_ij of light with k_y ≥ 0, (…, 4, 4), as `evaluate` has η_m.

        Raises:
            ValueError: if the table has none.
        """
        if self.mueller is None:
            raise RequestError("mueller: got a table of unpolarised light, wanted one built with polarised=True")
        return self._interpolated(self.mueller, m, c, g, wavelength)

    def _interpolated(
        self, table: NDArray[np.float32], m: ArrayLike, c: ArrayLike, g: ArrayLike, wavelength: ArrayLike
    ) -> Real:
        """What stands at the nodes, (K, nodes, …), linear between them."""
        m, c, g, wavelength = np.broadcast_arrays(np.asarray(m, np.int64), c, g, wavelength)
        axes, half = self.axes, np.abs(m) / 2
        p, r = g + c - half, g - c - half
        there = (p > 0) & (r > 0) & (p + r + 2 * half <= axes.reach * (1 + 1e-9))
        p, r, order = (np.where(there, v, 0) for v in (p, r, m))
        side = np.array([axes.side(k) for k in axes.orders])[order + axes.largest]
        offset = np.array([axes.offset(k) for k in axes.orders])[order + axes.largest]
        first, last = axes.range(g)
        z = np.clip((wavelength - first) / np.maximum(last - first, 1e-9), 0, 1) * (axes.planes - 1)
        result = np.zeros((*m.shape, *table.shape[2:]))
        wide = (..., *[None] * (table.ndim - 2))
        places = [_split(axes.position(p), side), _split(axes.position(r), side), _split(z, axes.planes)]
        for corner in np.ndindex(2, 2, 2):
            (i, j, k), weights = zip(
                *((low + up, f if up else 1 - f) for (low, f), up in zip(places, corner, strict=True)), strict=True
            )
            result += np.prod(weights, axis=0)[wide] * table[k, offset + i * side + j]
        return np.where(there[wide], result, 0)

    def efficiencies(self, direction: ArrayLike, wavelength: float) -> tuple[NDArray[np.int64], Real]:
        """The orders that propagate, ascending, and η_m of unpolarised light, as `rigorous.efficiencies` has them.

        Args:
            direction: ω_i, (3,), to the light.
            wavelength: µm.
        """
        omega = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        alpha, k_y = -omega[:2] * self.axes.period / wavelength
        g = np.sqrt((self.axes.period / wavelength) ** 2 - k_y**2)
        m = np.array(self.axes.orders)
        m = m[np.abs(alpha - m) < g]
        return m, self.evaluate(m, alpha - m / 2, g, wavelength)

    def save(self, path: str | os.PathLike[str], recipe: str = "") -> None:
        """Write the spectrum as an OpenEXR file, whole or not at all; `recipe` is the digest of its `Recipe`.

        Raises:
            OSError: if the file cannot be written.
        """
        axes = self.axes
        height, width = sum(axes.side(m) for m in axes.orders), axes.side(0)
        matrices = np.zeros((axes.planes, 0)) if self.mueller is None else self.mueller.reshape(axes.planes, -1)
        more = -(-matrices.shape[1] // width)
        sheet = np.zeros((axes.planes, height + more, width), np.float32)
        sheet[:, height:].reshape(axes.planes, -1)[:, : matrices.shape[1]] = matrices
        top = 0
        for m in axes.orders:
            side = axes.side(m)
            sheet[:, top : top + side, :side] = axes.square(self.values, m)
            top += side
        index = complex(self.int_ior)
        header = {
            "period": doubles(axes.period),
            "wavelengths": doubles(*axes.wavelengths),
            "steps": axes.steps,
            "planes": axes.planes,
            "harmonics": self.harmonics,
            "polarised": int(self.mueller is not None),
            "intIor": doubles(index.real, index.imag),
            **{_camel(name): doubles(getattr(self, name)) for name in _NUMBERS},
            **{_camel(name): getattr(self, name) for name in _TEXTS},
            "units": "lengths and wavelengths in micrometres",
        }
        write(path, FORMAT, FORMAT_VERSION, header, {_channel(k): plane for k, plane in enumerate(sheet)}, recipe)

    @classmethod
    def load(cls, path: str | os.PathLike[str], recipe: str | None = None) -> RigorousSpectrum:
        """Read a spectrum that `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a rigorous spectrum, is damaged, or was not built from that recipe.
        """
        path = Path(path)
        header, channels = read(path, FORMAT, FORMAT_VERSION, recipe)
        try:
            (period,), (shortest, longest) = header["period"], header["wavelengths"]
            axes = Axes(float(period), (float(shortest), float(longest)), header["steps"], header["planes"])
            sheet = np.stack([channels[_channel(k)].pixels for k in range(axes.planes)])
            squares, top = [], 0
            for m in axes.orders:
                side = axes.side(m)
                squares.append(sheet[:, top : top + side, :side].reshape(axes.planes, side**2))
                top += side
            mueller = None
            if header["polarised"]:
                flat = sheet[:, top:].reshape(axes.planes, -1)[:, : 16 * axes.nodes]
                mueller = np.ascontiguousarray(flat.reshape(axes.planes, axes.nodes, 4, 4))
            return cls(
                axes=axes,
                mueller=mueller,
                values=np.ascontiguousarray(np.concatenate(squares, axis=1)),
                int_ior=complex(*(float(x) for x in header["intIor"])),
                harmonics=header["harmonics"],
                **{name: header[_camel(name)] for name in _TEXTS},
                **{name: header[_camel(name)].item() for name in _NUMBERS},
            )
        except KeyError as error:
            raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _split(x: Real, count: NDArray[np.int64] | int) -> tuple[NDArray[np.int64], Real]:
    """The node below x, at most the last but one, and how far x is beyond it."""
    low = np.clip(np.floor(x).astype(np.int64), 0, np.maximum(np.asarray(count) - 2, 0))
    return low, x - low


def _channel(plane: int) -> str:
    return f"eta({plane:02d})"


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)
