"""A thin film on the relief: zinc sulphide of a hologram, the oxide of anodised titanium.

A film of constant thickness d along the normal follows the relief, so that the phase e^{iκh} is the same at both of its
faces, and interference changes R and T alone. With the indices n_0 of the medium of incidence, n_1 of the film and n_2
of the material, and s = n_0 sin θ_0 in all media,

    z_j = n_j cos θ_j = √(n_j² − s²),    β = 2π d z_1/λ,    r = (r_01 + r_12 e^{2iβ})/(1 + r_01 r_12 e^{2iβ})

for each polarisation (Airy 1833; Born and Wolf 1999, §1.6.4 and §14.4 for absorbing films). It is computed from the
admittances y_j = z_j (s) and z_j/n_j² (p), with r_jk = (y_j − y_k)/(y_j + y_k):

    r = (y_1 (y_0 − y_2) u + (y_0 y_2 − y_1²) v)/w,    w = y_1 (y_0 + y_2) u + (y_0 y_2 + y_1²) v,    R = |r|²,
    t = 2 g y_0 y_1 e^{iβ}/w,    u, v = (1 ± e^{2iβ})/2,    g = 1 (s), n_0/n_2 (p),    T = Re z_2/z_0 |t|²

so that d = 0 and n_1 = n_2 give the bare surface without rounding, and nothing overflows in a strongly absorbing film.
Indices are n + ik, fields e^{−iωt}. T is that of a material without absorption.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from .coat import absolute_index
from .fresnel import Conductor, Dielectric, Material, PerfectMirror
from .tables import larger
from .varying import VaryingNumber

MAX_THICKNESS = 2.0  # µm: the fringes of thicker films are narrow in λ


@dataclass
class Wave:
    """The waves of one polarisation: r and t are quotients, whose squares need no complex division.

    Attributes:
        reflected, transmitted: numerators.
        incident: the common denominator, w.
    """

    reflected: mi.Complex2f
    transmitted: mi.Complex2f
    incident: mi.Complex2f


def waves(
    cos: mi.Float, n_0: mi.Float, n_1: mi.Complex2f, n_2: mi.Complex2f, thickness: mi.Float, real: tuple[bool, bool]
) -> tuple[list[Wave], mi.Float]:
    """Return the waves of s and p, and Re z_2/z_0.

    Args:
        cos: cos θ_0.
        n_0, n_1, n_2: the indices.
        thickness: d/λ, λ in a medium of the index one.
        real: whether z_1 is real, and whether z_2 may be replaced by its real part.
    """
    z_0 = n_0 * larger(cos, 1e-6)
    square = dr.square(z_0) - dr.square(n_0)
    z_1, z_2 = (_root(n * n + square, is_real) for n, is_real in zip((n_1, n_2), real, strict=True))
    beta = dr.two_pi * thickness * z_1
    sin, cos = dr.sincos(beta.real)
    if real[0]:
        # Both u and v without their factor e^{iβ}.
        u, v, across = mi.Complex2f(cos, 0), mi.Complex2f(0, -sin), mi.Complex2f(1, 0)
    else:
        across = dr.exp(-beta.imag) * mi.Complex2f(cos, sin)
        twice = across * across
        u, v = 0.5 * (1 + twice), 0.5 * (1 - twice)
    found = []
    of_s, of_p = (z_0, z_1, z_2, 1), (z_0 / dr.square(n_0), z_1 / (n_1 * n_1), z_2 / (n_2 * n_2), n_0 / n_2)
    for y_0, y_1, y_2, gain in (of_s, of_p):
        outer, inner, film = y_0 * y_1 * u, y_1 * y_2 * u, (y_0 * y_2 * v, y_1 * y_1 * v)
        reflected, incident = outer - inner + (film[0] - film[1]), outer + inner + (film[0] + film[1])
        found.append(Wave(reflected, 2 * gain * y_0 * y_1 * across, incident))
    return found, z_2.real / z_0


def _root(square: mi.Complex2f, is_real: bool) -> mi.Complex2f:
    """Return √z², of which real and imaginary part are not negative, and not both zero at the critical angle."""
    if is_real:
        # A literal zero, with which Dr.Jit simplifies all that follows.
        return mi.Complex2f(dr.sqrt(larger(square.real, 1e-14)), 0)
    return dr.sqrt(mi.Complex2f(square.real, square.imag + 1e-10))


def with_film(props: mi.Properties, material: Material) -> Material:
    """Return the material with the film of `thin_film_thickness` and `thin_film_ior`, if there is one.

    Raises:
        RequestError: if a parameter is wrong, or the material cannot have a film.
    """
    given = [name for name in ("thin_film_thickness", "thin_film_ior") if name in props]
    if not given:
        return material
    if len(given) == 1:
        raise RequestError(f"{given[0]}: got it alone, wanted thin_film_thickness and thin_film_ior together")
    if isinstance(material, PerfectMirror):
        raise RequestError("thin_film_thickness: got a film on material=none, wanted a dielectric or a conductor")
    film = _of_index(props["thin_film_ior"], material.outside)
    return FilmedMaterial(material, film, VaryingNumber(props, "thin_film_thickness", 0.0))


def _of_index(ior: float | str, outside: float) -> Material:
    """Return the material of a film, for its index relative to the outside."""
    try:
        return Dielectric(absolute_index("thin_film_ior", ior), outside)
    except RequestError:
        if not isinstance(ior, str):
            raise
    try:
        return Conductor(ior, outside)
    except RequestError as error:
        reason = str(error).partition("; ")[0].replace("material: ", "thin_film_ior: ")
        raise RequestError(f"{reason}, a number, or a name as for int_ior") from None


class FilmedMaterial(Material):
    """A dielectric or a conductor under a thin film."""

    def __init__(self, below: Material, film: Material, thickness: VaryingNumber) -> None:
        self.below, self.film, self.thickness, self.outside = below, film, thickness, below.outside
        self.transparent, self.eta, self.varies = below.transparent, below.eta, thickness.varies
        shortest, longest = zip(below.wavelengths, film.wavelengths, strict=True)
        self.wavelengths = max(shortest), min(longest)
        self._check()

    def update(self) -> None:
        self.below.update()
        self.eta = self.below.eta
        self.thickness.read()
        self._check()

    def _check(self) -> None:
        low, high = self.thickness.values[[0, -1]]
        if low < 0 or high > MAX_THICKNESS:
            raise RequestError(
                f"thin_film_thickness: got {low if low < 0 else high:.6g}, wanted 0 to {MAX_THICKNESS:g} um; a thicker "
                "layer is a coat (coat_ior)"
            )
        if not self.thickness.varies:
            dr.make_opaque(self.thickness.value)
        # From each medium of incidence light propagates in a film of higher index.
        indices = [np.max(dr.detach(part.eta)) for part in (self.film, self.below) if part.transparent]
        self.propagates = self.film.transparent and indices[0] >= max([1.0, *indices[1:]])

    def _waves(
        self, si: mi.SurfaceInteraction3f, cos: mi.Float, active: mi.Bool, with_phase: bool
    ) -> list[tuple[list[Wave], mi.Float]]:
        """Return `waves` of each wavelength; without their phase, total reflection needs no imaginary z_2."""
        thickness, found = self.thickness.at(si, active) * (self.outside * 1e3), []
        indices = self.film.index(si, active), self.below.index(si, active)
        real = self.propagates, self.propagates and self.transparent and not with_phase
        for wavelength, n_1, n_2 in zip(si.wavelengths, *indices, strict=True):
            n_0 = mi.Float(1.0)
            if self.transparent:
                # Light from below.
                n_0, n_2 = dr.select(cos < 0, n_2.real, 1), mi.Complex2f(dr.select(cos < 0, 1, n_2.real), 0)
            found.append(waves(dr.abs(cos), n_0, n_1, n_2, thickness / wavelength, real))
        return found

    def powers(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, active: mi.Bool
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        reflected, transmitted = [], []
        for both, factor in self._waves(si, cos_half, active, with_phase=False):
            per_incident = [0.5 / dr.squared_norm(wave.incident) for wave in both]
            reflected.append(sum(dr.squared_norm(w.reflected) * p for w, p in zip(both, per_incident, strict=True)))
            through = sum(dr.squared_norm(w.transmitted) * p for w, p in zip(both, per_incident, strict=True))
            transmitted.append(factor * through)
        return mi.UnpolarizedSpectrum(reflected), mi.UnpolarizedSpectrum(transmitted)

    def planes(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, reflects: mi.Bool, active: mi.Bool
    ) -> list[mi.Matrix4f]:
        matrices = []
        for both, factor in self._waves(si, cos_half, active, with_phase=True):
            s, p = (dr.select(reflects, wave.reflected, wave.transmitted) / wave.incident for wave in both)
            of_s, of_p, cross = dr.squared_norm(s), dr.squared_norm(p), s * dr.conj(p)
            mean, half = 0.5 * (of_s + of_p), 0.5 * (of_s - of_p)
            # Mitsuba's fields are e^{iωt}.
            re, im = cross.real, -cross.imag
            matrix = mi.Matrix4f([[mean, half, 0, 0], [half, mean, 0, 0], [0, 0, re, im], [0, 0, -im, re]])
            matrices.append(matrix * dr.select(reflects, 1, factor))
        return matrices

    def traverse(self, callback: mi.TraversalCallback) -> None:
        self.below.traverse(callback)
        self.thickness.put(callback)

    def __repr__(self) -> str:
        return f"{self.below}, under {self.thickness} um of {self.film}"
