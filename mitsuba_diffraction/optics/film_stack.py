"""R and T of a plane under a stack of films, by characteristic matrices, for arrays of NumPy and of Dr.Jit.

With the indices n_0 of the medium of incidence, n_j of the films and n_s of the medium below, and s = n_0 sin θ_0 in
all media, z_j = n_j cos θ_j = √(n_j² − s²), the phase is δ_j = 2π d_j z_j/λ and the admittance is y_j = z_j
(s polarisation), z_j/n_j² (p). From the innermost film outwards, beginning with (B, C) = (1, y_s),

    B ← cos δ_j B − i sin δ_j C/y_j,    C ← −i sin δ_j y_j B + cos δ_j C

    r = (y_0 B − C)/(y_0 B + C),    t = 2 g y_0/(y_0 B + C),    g = 1 (s), n_0/n_s (p),    T = Re z_s/z_0 |t|²

(Abelès 1950; Born and Wolf 1999, §1.6). Films of constant thickness along the normal follow the relief, so that the
phase e^{iκh} is the same at all of their faces, and R and T alone change. Each matrix is multiplied by e^{iδ_j}, so
that nothing overflows in absorbing films; R does not change, t has the product of these factors. Indices are n + ik,
fields e^{−iωt}. T holds for a medium below that does not absorb.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..array_types import Real
from .geometry import AnyArray
from .refractive_indices import NOMINAL_WAVELENGTH, RefractiveIndex

Plane = Callable[[Real], tuple[Real, Real]]
"""R and T of unpolarised light at the cosines of the angles of incidence."""

COSINES = 512  # intervals of the cosine between which a plane is tabulated
MAX_PHASE_STEP = 1.0  # radians between states of a stack whose thickness varies
MAX_STATES = 9


def across_film(field: tuple[AnyArray, AnyArray], y: AnyArray, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return (B, C) at the outer face of a film from (B, C) at its inner face.

    Args:
        field: B and C.
        y: the admittance of the film.
        u, v: cos δ and −i sin δ, or both times e^{iδ}: (1 ± e^{2iδ})/2.
    """
    b, c = field
    return u * b + v / y * c, v * y * b + u * c


def reflected_and_incident(field: tuple[AnyArray, AnyArray], y_0: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Return y_0 B − C and y_0 B + C."""
    b, c = field
    return y_0 * b - c, y_0 * b + c


def r_and_t(
    cosine: Real, outside: complex, films: Sequence[tuple[complex, float]], below: complex
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return R and T of s- and p-polarised light, (2, ...) each.

    Args:
        cosine: cos θ_0, any shape.
        outside: n_0.
        films: n_j and d_j/λ, λ in vacuum, from the outside in.
        below: n_s.
    """
    cosine = np.maximum(np.asarray(cosine, np.float64), 1e-9)
    square = np.asarray((outside * cosine) ** 2 - outside**2, np.complex128)
    z_0, z_s = outside * cosine, _root(below**2 + square)
    fields = [(1.0 + 0 * z_s, z_s), (1.0 + 0 * z_s, z_s / below**2)]
    across = np.ones_like(z_s)
    for n, depth in reversed(films):
        z = _root(n**2 + square)
        factor = np.exp(2j * np.pi * depth * z)
        u, v = (1 + factor**2) / 2, (1 - factor**2) / 2
        fields = [across_film(field, y, u, v) for field, y in zip(fields, (z, z / n**2), strict=True)]
        across = across * factor
    reflected, transmitted = [], []
    for field, y_0, gain in zip(fields, (z_0, z_0 / outside**2), (1, outside / below), strict=True):
        numerator, incident = reflected_and_incident(field, y_0)
        reflected.append(np.abs(numerator / incident) ** 2)
        transmitted.append(z_s.real / z_0.real * np.abs(2 * gain * y_0 * across / incident) ** 2)
    return np.array(reflected), np.array(transmitted)


def _root(square: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return √z², with real and imaginary part not negative, and not both zero at the critical angle."""
    return np.sqrt(square + 1e-14j)


@dataclass(frozen=True)
class Stack:
    """A dielectric below films, next to a medium of constant index: all that R and T depend on.

    Attributes:
        outside: absolute index of the medium above.
        below: absolute index of the dielectric.
        films: absolute indices and thicknesses in µm, from the outside in.
        scales: bounds of a factor of the thicknesses.
    """

    outside: float
    below: RefractiveIndex
    films: tuple[tuple[RefractiveIndex, float], ...] = ()
    scales: tuple[float, float] = (1.0, 1.0)

    @property
    def nominal(self) -> float:
        """η in the middle of visible light, for which tables are laid out."""
        return self.index(NOMINAL_WAVELENGTH)

    def index(self, wavelength: float) -> float:
        """Return η of the dielectric relative to the outside at a wavelength in µm, in vacuum."""
        return float(self.below(wavelength).real) / self.outside

    def max_difference(self, other: Stack) -> float:
        """Return the maximum change of the thickness of a film, µm, between stacks of the same media."""
        pairs = zip(self.films, other.films, strict=True)
        scales = list(zip(self.scales, other.scales, strict=True))
        return max((abs(a[1] * s - b[1] * t) for a, b in pairs for s, t in scales), default=0.0)

    def phase(self, frequencies: tuple[float, float]) -> float:
        """Return the change of the phase of light that crosses the films twice, between two 1/λ above in 1/µm."""
        path = sum(abs(complex(n.nominal)) * thickness for n, thickness in self.films) * max(self.scales)
        return 4 * np.pi * path * (frequencies[1] - frequencies[0]) / self.outside

    @property
    def is_plain(self) -> bool:
        """Whether the surface is bare and its index the same at all wavelengths."""
        return self.below.is_constant and not any(thickness for _, thickness in self.films)

    def planes(self, wavelength: float, side: int, laterals: tuple[float, float], step: float) -> list[Plane]:
        """Return R and T at a wavelength for the thicknesses that occur, as functions of cos θ in the medium of ω.

        Args:
            wavelength: µm, in vacuum, with the mean of the lateral scales.
            side: 1 for light from above, −1 from below.
            laterals: bounds of the scale of lengths along the surface; the scale of the thickness is relative to it.
            step: difference of 1/λ (1/µm) to either side for which R and T stand, too: it has the effect of another
                thickness.
        """
        films = [(complex(n(wavelength)), thickness) for n, thickness in self.films]
        media = complex(self.outside), complex(self.below(wavelength).real)
        mean = sum(laterals) / 2
        low, high = (
            scale * mean / lateral * (1 + sign * step * wavelength / (mean * self.outside))
            for scale, lateral, sign in zip(self.scales, reversed(laterals), (-1, 1), strict=True)
        )
        phase = 4 * np.pi / wavelength * sum(n.real * thickness for n, thickness in films) * (high - low)
        count = min(1 + int(phase / (2 * MAX_PHASE_STEP)), MAX_STATES)
        scales = np.linspace(low, high, count) if count > 1 else [(low + high) / 2]
        ratio = self.index(wavelength) ** side
        cosines = np.linspace(0, 1, COSINES + 1)
        if ratio < 1:
            # R and T are functions of the root of the distance from the critical angle.
            critical = np.sqrt(1 - ratio**2)
            distance = np.linspace(-1, 1, COSINES // 2 + 1)
            near = critical + np.sign(distance) * distance**2 * np.where(distance < 0, critical, 1 - critical)
            cosines = np.union1d(cosines, near)
        found: list[Plane] = []
        for scale in scales:
            layers = [(n, scale * thickness / wavelength) for n, thickness in films]
            if side < 0:
                of_side = r_and_t(cosines, media[1], layers[::-1], media[0])
            else:
                of_side = r_and_t(cosines, media[0], layers, media[1])
            found.append(partial(_interpolated, cosines, *np.mean(of_side, axis=1)))
        return found


def _interpolated(cosines: Real, reflected: Real, transmitted: Real, cosine: Real) -> tuple[Real, Real]:
    """Return R and T of a table over cosines, linear between them."""
    return np.interp(cosine, cosines, reflected), np.interp(cosine, cosines, transmitted)
