"""Thin films on the relief: zinc sulphide of a hologram, the oxide of anodised titanium, the stack of a beetle.

R and T of a plane under the films follow from the characteristic matrices of `../optics/film_stack.py`, which E and
samplers use as well (`film_stack.r_and_t`: what changes |r|² or |t|² here changes it there). Films are evaluated by a
loop over a table of their indices, whose length is opaque; one film without the loop.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..optics import film_stack
from ..optics.refractive_indices import KnownRange, RefractiveIndex, is_file
from .device_tables import integer_part, larger, opaque
from .fresnel import Boundary, Cosines, PerfectMirror
from .indices import Dispersion, index_from
from .varying import VaryingNumber, number_or_text

MAX_THICKNESS = 4.0  # µm in all: the fringes of thicker films are narrow in λ
MAX_FILMS = 100
_Fields: TypeAlias = "list[tuple[mi.Complex2f, mi.Complex2f]]"
"""(B, C) of s and p at a face of a film."""
_Face: TypeAlias = "tuple[_Fields, mi.Complex2f]"
"""These fields, and the product of the factors e^{iδ} of the films below."""


@dataclass
class Wave:
    """The waves of one polarisation: r and t are quotients, whose squares need no complex division.

    Attributes:
        reflected, transmitted: numerators.
        incident: the common denominator, y_0 B + C.
    """

    reflected: mi.Complex2f
    transmitted: mi.Complex2f
    incident: mi.Complex2f


@dataclass
class _Plane:
    """A plane at one wavelength: the components along it and below it.

    Attributes:
        n_0, n_s: the indices above and below.
        z_0, z_s: n cos θ in them.
        square: −(n_0 sin θ_0)², which added to n² gives z².
    """

    n_0: mi.Float
    n_s: mi.Complex2f
    z_0: mi.Float
    z_s: mi.Complex2f
    square: mi.Float

    @classmethod
    def of(cls, cos: mi.Float, n_0: mi.Float, n_s: mi.Complex2f, is_real: bool) -> _Plane:
        """Return the plane at cos θ_0; `is_real`: whether z_s may be replaced by its real part."""
        z_0 = n_0 * larger(cos, 1e-6)
        square = dr.square(z_0) - dr.square(n_0)
        return cls(n_0, n_s, z_0, _root(n_s * n_s + square, is_real), square)

    def fields(self) -> _Fields:
        """Return (B, C) of s and p at the medium below."""
        one = mi.Complex2f(1, 0)
        return [(one, self.z_s), (one, self.z_s / (self.n_s * self.n_s))]

    def waves(self, fields: _Fields, across: mi.Complex2f) -> list[Wave]:
        """Return the waves of s and p from (B, C) at the outermost face and the product of the factors e^{iδ}."""
        found = []
        of_s, of_p = (self.z_0, mi.Complex2f(1, 0)), (self.z_0 / dr.square(self.n_0), self.n_0 / self.n_s)
        for field, (y_0, gain) in zip(fields, (of_s, of_p), strict=True):
            reflected, incident = film_stack.reflected_and_incident(field, y_0)
            found.append(Wave(reflected, 2 * y_0 * gain * across, incident))
        return found


def _root(square: mi.Complex2f, is_real: bool) -> mi.Complex2f:
    """Return √z², with real and imaginary part not negative, and not both zero at the critical angle."""
    if is_real:
        # A literal zero, with which Dr.Jit simplifies all that follows.
        return mi.Complex2f(dr.sqrt(larger(square.real, 1e-14)), 0)
    return dr.sqrt(mi.Complex2f(square.real, square.imag + 1e-10))


def _crossed(
    fields: _Fields,
    across: mi.Complex2f,
    n: mi.Complex2f,
    thickness: mi.Float,
    square: mi.Float,
    is_real: bool,
) -> _Face:
    """Return (B, C) of s and p at the outer face of a film, and `across` times its factor.

    Args:
        fields, across: at its inner face.
        n: its index.
        thickness: d/λ, λ in a medium of the index one.
        square: of `_Plane`.
        is_real: whether z is real.
    """
    z = _root(n * n + square, is_real)
    delta = dr.two_pi * thickness * z
    sin, cos = dr.sincos(delta.real)
    if is_real:
        # Both u and v without their factor e^{iδ}.
        u, v = mi.Complex2f(cos, 0), mi.Complex2f(0, -sin)
    else:
        factor = dr.exp(-delta.imag) * mi.Complex2f(cos, sin)
        twice = factor * factor
        u, v, across = 0.5 * (1 + twice), 0.5 * (1 - twice), across * factor
    return [film_stack.across_film(field, y, u, v) for field, y in zip(fields, (z, z / (n * n)), strict=True)], across


def with_film(bare: Boundary, given: Mapping[str, Any]) -> Boundary:
    """Return the boundary with the films of `thin_film_thickness` and `thin_film_ior`, if there are any.

    Raises:
        RequestError: if a parameter is wrong, or the medium below cannot have a film.
    """
    of_films = [name for name in ("thin_film_thickness", "thin_film_ior") if name in given]
    if not of_films:
        if "thin_film_scale" in given:
            raise RequestError("thin_film_scale: got it alone, wanted thin_film_thickness and thin_film_ior with it")
        return bare
    if len(of_films) == 1:
        raise RequestError(f"{of_films[0]}: got it alone, wanted thin_film_thickness and thin_film_ior together")
    if isinstance(bare, PerfectMirror):
        raise RequestError("thin_film_thickness: got a film on material=none, wanted a dielectric or a conductor")
    iors, thickness = given["thin_film_ior"], given["thin_film_thickness"]
    indices = list_entries("thin_film_ior", iors) if isinstance(iors, str) else [iors]
    media = [index_from("thin_film_ior", number_or_text(ior), absorbing=True) for ior in indices]
    scale = VaryingNumber("thin_film_scale", given.get("thin_film_scale", 1.0))
    if len(media) > 1 or (isinstance(thickness, str) and _is_list(thickness)):
        thickness = _thicknesses(thickness, len(media))
    return FilmedBoundary(bare, media, VaryingNumber("thin_film_thickness", thickness), scale)


def _thicknesses(given: Any, count: int) -> list[float]:
    """Return the thicknesses of several films from the list of a scene.

    Raises:
        RequestError: if it is no list of as many numbers.
    """
    if not isinstance(given, str):
        given_as = "one number" if not isinstance(given, mi.Object) else "a texture"
        raise RequestError(
            f"thin_film_thickness: got {given_as} for {count} films, wanted a list of as many numbers; "
            "thin_film_scale is a number or texture by which they are multiplied"
        )
    numbers = [number_or_text(text) for text in list_entries("thin_film_thickness", given)]
    if bad := [number for number in numbers if not is_number(number)]:
        raise RequestError(f"thin_film_thickness: got {bad[0]!r}, wanted 0 to {MAX_THICKNESS:g} um")
    if len(numbers) != count:
        raise RequestError(
            f"thin_film_thickness: got {len(numbers)} thicknesses for {count} films (thin_film_ior), wanted one for "
            "each, from the outside in"
        )
    return numbers


def _is_list(text: str) -> bool:
    return "," in text or re.search(r"\d\s*[x×]\s*\(", text) is not None


def list_entries(name: str, text: str) -> list[str]:
    """Return the entries of a list such as "2.35, 1.38", or with repetitions, "8 x (2.35, 1.38), 2.35".

    The paths of files may have commas and parentheses.

    Raises:
        RequestError: if it is no such list, or has too many entries.
    """
    found: list[str] = []
    rest = text.strip()
    while rest:
        file = _leading_file(rest)
        repeated = None if file else re.match(r"(\d+)\s*[x×]\s*\(((?:[^()]|\([^()]*\))*)\)\s*(?:,|$)", rest)
        match = file or repeated or re.match(r"([^,()]+)(?:,|$)", rest)
        if match is None:
            raise RequestError(f"{name}: got {text!r}, wanted a list such as '2.35, 1.38' or '8 x (2.35, 1.38), 2.35'")
        if match is not file and re.match(r"\d+,\d+\s*(?:[,;]\s|$)", rest):
            raise RequestError(
                f"{name}: got {text!r}, a decimal comma? wanted a point, or, in a list of whole numbers, a space after "
                "the comma"
            )
        count, entries = (int(repeated[1]), list_entries(name, repeated[2])) if repeated else (1, [match[1].strip()])
        if "" in entries or not 0 < count * len(entries) + len(found) <= MAX_FILMS:
            raise RequestError(f"{name}: got {text!r}, wanted a list of 1 to {MAX_FILMS} entries")
        found += count * entries
        rest = rest[match.end() :].strip()
    if not found or text.rstrip().endswith(","):
        raise RequestError(f"{name}: got {text!r}, wanted a list of 1 to {MAX_FILMS} entries")
    return found


def _leading_file(text: str) -> re.Match[str] | None:
    """Return the longest beginning of a list that is the path of a file of an index, if there is one."""
    for end in reversed([comma.start() for comma in re.finditer(",|$", text)]):
        path = text[:end].strip()
        if is_file(path) and Path(str(mi.file_resolver().resolve(path))).is_file():
            return re.compile(f"(.{{{end}}})(?:,|$)", re.DOTALL).match(text)
    return None


class FilmedBoundary(Boundary):
    """A dielectric or a conductor under films.

    Attributes:
        below: the boundary without the films.
        films: the indices, absolute, from the outside in.
        thickness: of one film, a number or a texture; of several, as many numbers, µm.
        scale: the factor of the thicknesses.
        propagates: whether there is one film, in which light from either medium propagates at all angles.
    """

    def __init__(
        self, below: Boundary, films: list[RefractiveIndex], thickness: VaryingNumber, scale: VaryingNumber
    ) -> None:
        self.below, self.films, self.thickness, self.scale = below, films, thickness, scale
        self.outside, self.coat = below.outside, below.coat
        self.transparent, self.dispersion = below.transparent, below.dispersion
        self.varies, self.count = below.varies or thickness.varies or scale.varies, opaque(len(films))
        has_number = len(films) == 1 and films[0].is_constant and not films[0].absorbs
        self.indices: mi.Float | Dispersion = (
            opaque(films[0].nominal.real / self.outside) if has_number else Dispersion(films, self.outside)
        )
        self.update()

    @property
    def eta(self) -> Any:  # type: ignore[override]
        return self.below.eta

    def known_ranges(self) -> tuple[KnownRange, ...]:
        return (*self.below.known_ranges(), *(film.known_range("thin_film_ior") for film in self.films))

    def update(self) -> None:
        self.below.update()
        for number in (self.thickness, self.scale):
            number.read()
            if not number.varies:
                dr.make_opaque(number.value)
        self._check()
        # From each medium of incidence light propagates in a film of higher index.
        values = self.films[0].values.real / self.outside
        below = float(np.max(dr.detach(self.below.eta))) if self.transparent else 1.0
        if self.dispersion is not None:
            below = float(self.below.stack(below).below.values.real.max()) / self.outside
        above = 1.0 if self.coat is None else self.coat.medium.values.real.max() / self.outside
        self.propagates = len(self.films) == 1 and not self.films[0].absorbs and values.min() >= max(above, below)

    def _check(self) -> None:
        if (scale := self.scale.values[0]) < 0:
            raise RequestError(f"thin_film_scale: got {scale:.6g}, wanted 0 or more")
        thicknesses, (_, high) = self.thicknesses()
        if len(thicknesses) != len(self.films):
            raise RequestError(f"thin_film_thickness: got {len(thicknesses)} thicknesses for {len(self.films)} films")
        if (bad := thicknesses[~(np.isfinite(thicknesses) & (thicknesses >= 0))]).size:
            raise RequestError(f"thin_film_thickness: got {bad[0]:.6g}, wanted 0 to {MAX_THICKNESS:g} um")
        if (total := high * thicknesses.sum()) > MAX_THICKNESS * (1 + 1e-6):
            raise RequestError(
                f"thin_film_thickness: got {total:.6g}, wanted 0 to {MAX_THICKNESS:g} um; a thicker layer is a coat "
                "(coat_ior)"
            )

    def thicknesses(self) -> tuple[np.ndarray, tuple[float, float]]:
        """Return the thicknesses of the films in µm, and the bounds of their factor."""
        low_scale, high_scale = map(float, self.scale.values[[0, -1]])
        if not self.thickness.varies:
            return np.ravel(np.array(dr.detach(self.thickness.value), np.float64)), (low_scale, high_scale)
        low, high = self.thickness.values[[0, -1]]
        if low < 0 or high <= 0:
            return np.array([low]), (1.0, 1.0)
        return np.array([high]), (float(low / high * low_scale), high_scale)

    def stack(self, eta: float) -> film_stack.Stack:
        thicknesses, scales = self.thicknesses()
        films = tuple((n, float(d)) for n, d in zip(self.films, thicknesses, strict=True))
        return film_stack.Stack(self.outside, self.below.stack(eta).below, films, scales)

    def _waves(
        self, si: mi.SurfaceInteraction3f, cos: Cosines, active: mi.Bool, with_phase: bool
    ) -> list[tuple[list[Wave], mi.Float]]:
        """Return the waves of each wavelength and Re z_s/z_0; without their phase, total reflection has a real z_s."""
        cosines, above, scale = mi.UnpolarizedSpectrum(cos), self.above(si), self.scale.value_at(si, active)
        is_real, indices = self.propagates and self.transparent and not with_phase, self.indices
        planes = [
            _Plane.of(dr.abs(cosine), *self._media(cosine, n_s), is_real)
            for cosine, n_s in zip(cosines, self.below.index(si, active), strict=True)
        ]
        positions = [indices.position(w) for w in si.wavelengths] if isinstance(indices, Dispersion) else []

        def crossed(thickness: mi.Float, faces: list[_Face], film: mi.UInt32 | None = None) -> list[_Face]:
            found = []
            for channel, (plane, face) in enumerate(zip(planes, faces, strict=True)):
                n = indices.index_at(positions[channel], film) if positions else mi.Complex2f(indices, 0)
                depth = thickness / si.wavelengths[channel]
                if self.coat is not None:
                    n, depth = n / above[channel], depth * above[channel]
                found.append(_crossed(*face, n, depth, plane.square, self.propagates))
            return found

        films, from_below, nanometres = integer_part(self.count), cosines[0] < 0, self.outside * 1e3

        def body(step: mi.UInt32, faces: list[_Face]) -> tuple[mi.UInt32, list[_Face]]:
            # From the innermost film outwards; for light from below, from the outermost inwards.
            film = dr.select(from_below, step, films - 1 - step) if self.transparent else films - 1 - step
            thickness = scale * nanometres * dr.gather(mi.Float, self.thickness.value, film, active)
            return step + 1, crossed(thickness, faces, film)

        faces = [(plane.fields(), mi.Complex2f(1, 0)) for plane in planes]
        if len(self.films) == 1:
            faces = crossed(self.thickness.value_at(si, active) * scale * nanometres, faces)
        elif dr.grad_enabled(self.thickness.value, scale, planes):
            # Dr.Jit cannot differentiate the loop in reverse mode.
            for step in range(len(self.films)):
                _, faces = body(mi.UInt32(step), faces)
        else:
            _, faces = dr.while_loop((mi.UInt32(0), faces), lambda step, _: step < films, body)
        return [(plane.waves(*face), plane.z_s.real / plane.z_0) for plane, face in zip(planes, faces, strict=True)]

    def _media(self, cos: mi.Float, n_s: mi.Complex2f) -> tuple[mi.Float, mi.Complex2f]:
        """Return n_0 and n_s, exchanged for light from below."""
        if not self.transparent:
            return mi.Float(1.0), n_s
        return dr.select(cos < 0, n_s.real, 1), mi.Complex2f(dr.select(cos < 0, 1, n_s.real), 0)

    def r_and_t(
        self, si: mi.SurfaceInteraction3f, cos_half: Cosines, active: mi.Bool
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
        self.scale.put(callback)
        self.thickness.put(callback)

    def __repr__(self) -> str:
        thicknesses = [self.thickness] if self.thickness.varies else [f"{d:.4g}" for d in self.thicknesses()[0]]
        films = ", ".join(f"{d} um of {n}" for n, d in zip(self.films, thicknesses, strict=True))
        return f"{self.below}, under {films}"
