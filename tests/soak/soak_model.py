"""The model of docs/theory.md in float64, written from its formulas, to judge the plugin: it imports nothing of it.

All indices are absolute, lengths are in µm, wave vectors k = n ω in units of 2π/λ with λ in vacuum.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np


@functools.cache
def metal(name):
    """λ in µm, n and k from Mitsuba's tables, which are in ångström."""
    folder = Path(mi.__file__).parent / "data" / "ior"
    (wavelengths, n), (_, k) = (np.loadtxt(folder / f"{name}.{part}.spd", comments="#").T for part in ("eta", "k"))
    return wavelengths / (1e4 if wavelengths[0] > 2000 else 1e3), n, k


@dataclass(frozen=True)
class Cauchy:
    """A medium with the index a + b/λ², λ in µm, without absorption."""

    a: float
    b: float

    def at(self, wavelength):
        return self.a + self.b / wavelength**2


def index_of(material, wavelength):
    """n + ik at wavelengths in µm, of a metal, a medium with dispersion or a number."""
    if isinstance(material, Cauchy):
        return material.at(wavelength) + 0j
    if isinstance(material, str):
        at, n, k = metal(material)
        return np.interp(wavelength, at, n) + 1j * np.interp(wavelength, at, k)
    return material + 0j * wavelength


def plane(cosine, n_0, films, n_2, wavelength):
    """R and T of a plane under films (n, d) from the outside in, unpolarised (Airy, film by film). n_0 is real."""
    cosine = np.clip(np.asarray(cosine, float), 1e-6, 1)
    n_0, n_2 = np.asarray(n_0, complex) + 0 * cosine, np.asarray(n_2, complex) + 0 * cosine
    sine = n_0 * np.sqrt(1 - cosine**2)

    def normal(n):
        root = np.sqrt(n**2 - sine**2)  # n cos θ, decaying where it is complex
        return np.where(root.imag < 0, -root, root)

    media = [n_0, *(np.asarray(n, complex) + 0 * cosine for n, _ in films), n_2]
    z = [normal(n) for n in media]
    phases = [np.exp(2j * np.pi * d * z_j / wavelength) for (_, d), z_j in zip(films, z[1:], strict=False)]
    reflected, transmitted = 0, 0
    for y in (z, [z_j / n**2 for z_j, n in zip(z, media, strict=True)]):
        r, t = 0.0, 1.0  # of all that is below a face; t of the field whose admittance is y
        for j in range(len(films), -1, -1):
            phase = phases[j] if j < len(films) else 1.0
            face = (y[j] - y[j + 1]) / (y[j] + y[j + 1])
            below = 1 + face * r * phase**2
            t = 2 * y[j] / (y[j] + y[j + 1]) * phase * t / below
            r = (face + r * phase**2) / below
        reflected = reflected + np.abs(r) ** 2 / 2
        transmitted = transmitted + np.abs(t) ** 2 * y[-1].real / y[0].real / 2
    return reflected, transmitted


@functools.cache
def horizon_gain():
    """x and g(x) of g(x) ∫₀^∞ φ(x − y) g(y) dy = 1."""
    step = 0.01
    x = (np.arange(1200) + 0.5) * step
    kernel = np.exp(-((x[:, None] - x) ** 2) / 2) / np.sqrt(2 * np.pi) * step
    tail = np.array([0.5 * (1 + math.erf(v / math.sqrt(2))) for v in x - x[-1] - step / 2])  # where g is one
    g = np.ones_like(x)
    for _ in range(400):
        g = np.sqrt(g / (kernel @ g + tail))
    return x, g


def gain(x):
    at, g = horizon_gain()
    return np.interp(x, at, g)


@dataclass
class Way:
    """One direction of a pair: k_∥ and k_z² outside, n outside and next to the relief, 1 above or −1 below."""

    tangent: np.ndarray
    outer: np.ndarray
    inner: np.ndarray
    sign: np.ndarray

    @property
    def square(self):
        """k_z² outside."""
        return self.outer**2 - (self.tangent**2).sum(-1)

    def normal(self, square):
        """|k_z| next to the relief, from k_z² outside."""
        return np.sqrt(np.maximum(square + self.inner**2 - self.outer**2, 1e-24))


class Model:
    """f and the directions of orders, of a tile whose orders are evaluated one by one.

    `configuration` has: patches (list of heights), tile (T_x, T_y), coherence_length, and the parameters of a scene.
    """

    def __init__(self, configuration):
        c = self.c = configuration
        self.patches = [np.asarray(h, float) for h in c.surface.patches()]
        self.tile = np.array(c.surface.tile)
        self.sigma_q = 1 / (2 * np.sqrt(2) * np.pi * c.coherence_length / 4)

    # The media.
    def way(self, omega, wavelength, orientation):
        """`omega` (n, 3) in the local frame → along the axes of the pattern. Wavelengths (n,) or a number."""
        angle = np.deg2rad(orientation)
        cos, sin = np.cos(angle), np.sin(angle)
        along = np.stack([cos * omega[:, 0] + sin * omega[:, 1], cos * omega[:, 1] - sin * omega[:, 0]], -1)
        above = omega[:, 2] > 0
        outer, inner = self.indices(above, wavelength)
        return Way(along * outer[:, None], outer, inner, np.where(above, 1.0, -1.0))

    def above(self, wavelength):
        """n next to the relief, above it."""
        return index_of(self.c.coat or self.c.outside, wavelength).real

    def indices(self, above, wavelength):
        """n outside and next to the relief, above or below, at wavelengths in µm that broadcast."""
        c = self.c
        inner_above = self.above(wavelength)
        below = index_of(c.material, wavelength).real if c.transmission != "none" else np.nan
        inner = np.where(above, inner_above, below)
        outer = np.where(above, c.outside, c.outside if c.transmission == "sheet" else below)
        return outer, inner

    def of_plane(self, cosine, from_above, wavelength, at):
        """R and T of the material next to the relief, at the angle of a facet."""
        c = self.c
        if c.material == "none":
            return np.ones_like(cosine), np.zeros_like(cosine)
        n_0, n_2 = self.above(wavelength), index_of(c.material, wavelength)
        films = [(index_of(n, wavelength), at.film_scale * thickness) for n, thickness in c.films]
        above = plane(cosine, n_0, films, n_2, wavelength)
        if np.all(from_above):
            return above
        below = plane(cosine, n_2, films[::-1], n_0, wavelength)
        return tuple(np.where(from_above, a, b) for a, b in zip(above, below, strict=True))

    def face(self, omega, wavelength):
        """T of the face of a coat, or of the flat face of a sheet, for directions outside."""
        c, cosine = self.c, np.abs(omega[:, 2])
        if c.coat:
            return plane(cosine, c.outside, [], self.above(wavelength), 1.0)[1]
        if c.transmission == "sheet":
            transmitted = plane(cosine, c.outside, [], index_of(c.material, wavelength), 1.0)[1]
            return np.where(omega[:, 2] < 0, transmitted, 1)
        return np.ones(len(omega))

    # The relief.
    def eta(self, m, kappa):
        """η_m(κ) of orders (n, 2) at signed κ (n,), the mean of the patches."""
        total = 0.0
        for heights in self.patches:
            rows, columns = heights.shape
            # Each of the two sums in turn; e^{iκh} of one pair at a time, as it may be large.
            of_x = np.exp(-2j * np.pi * np.outer(m[:, 0], np.arange(columns)) / columns) / columns
            of_y = np.exp(-2j * np.pi * np.outer(m[:, 1], np.arange(rows)) / rows) / rows
            if rows == 1:
                amplitude = (np.exp(1j * np.outer(kappa, heights[0])) * of_x).sum(-1)
            elif columns == 1:
                amplitude = (np.exp(1j * np.outer(kappa, heights[:, 0])) * of_y).sum(-1)
            elif self.c.surface.kind == "crossed":  # h(x, y) = f(x) + g(y)
                along_x, along_y = heights[0] - heights[0, 0], heights[:, 0]
                amplitude = (np.exp(1j * np.outer(kappa, along_x)) * of_x).sum(-1)
                amplitude = amplitude * (np.exp(1j * np.outer(kappa, along_y)) * of_y).sum(-1)
            else:
                amplitude = np.array(
                    [y @ (np.exp(1j * k * heights) @ x) for x, y, k in zip(of_x, of_y, kappa, strict=True)]
                )
            nyquist = np.where((2 * np.abs(m[:, 0]) == columns), 0.5, 1) * np.where(2 * np.abs(m[:, 1]) == rows, 0.5, 1)
            inside = (2 * np.abs(m[:, 0]) <= columns) & (2 * np.abs(m[:, 1]) <= rows)
            total = total + np.abs(amplitude) ** 2 * nyquist * inside
        return total / len(self.patches)

    def k_g(self, k_iz, k_oz, step_square, n_i, n_o, reflects):
        """K G, from |k_z| next to the relief and |v_∥|² = |λq|²."""
        v_z = np.where(reflects, k_iz + k_oz, np.abs(k_iz - k_oz))
        v = np.sqrt(step_square + v_z**2)
        excess = np.where(reflects, 0, n_i**2 - n_o**2)
        i_h, o_h = np.abs(v**2 + excess) / (2 * v * n_i), np.abs(v**2 - excess) / (2 * v * n_o)
        cos_i, cos_o, h_z = k_iz / n_i, k_oz / n_o, v_z / v
        k = i_h * o_h * v**2 / (cos_i * cos_o * np.maximum(v_z, 1e-12) ** 2)
        if self.c.shadowing == "none":
            g = 1.0
        else:
            in_reflection = np.minimum(1, 2 * h_z * np.minimum(cos_i, cos_o) / i_h)
            in_transmission = np.minimum(1, 2 * np.minimum(cos_i / i_h, cos_o / o_h)) ** 2
            g = np.where(reflects, in_reflection, in_transmission)
        refracts = reflects | (v**2 < np.abs(excess))  # no facet refracts one into the other beyond
        return np.where(refracts, k * g, 0), i_h, v_z

    def orders(self, omega, wavelength, below, at):
        """Orders that propagate from one ω_i (3,) at one wavelength: m (n, 2) and ω_o (n, 3) in the local frame."""
        way = self.way(omega[None], wavelength, at.orientation)
        outer, _ = self.indices(np.array([not below]), wavelength)
        tile = self.tile * at.lateral_scale
        limit = np.floor((way.outer + outer) * tile / wavelength).astype(int)
        limit = np.where(np.array(self.patches[0].shape[::-1]) == 1, 0, limit)
        m = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in limit)), -1).reshape(-1, 2)
        tangent = (-way.tangent - wavelength * m / tile) / outer
        square = 1 - (tangent**2).sum(-1)
        keep = square > 0
        m, tangent, square = m[keep], tangent[keep], square[keep]
        angle = np.deg2rad(at.orientation)
        cos, sin = np.cos(angle), np.sin(angle)
        x, y = cos * tangent[:, 0] - sin * tangent[:, 1], sin * tangent[:, 0] + cos * tangent[:, 1]
        return m, np.stack([x, y, np.sqrt(square) * (-1 if below else 1)], -1)

    def terms(self, wi, wo, m, wavelength, at):
        """Of the orders m of pairs (n, 3): power per frequency over η N, η, N, and |κ|.

        f = the product of the first three, without E, the faces and the base.
        """
        i, o = (self.way(omega, wavelength, at.orientation) for omega in (wi, wo))
        reflects = i.sign == o.sign
        q = -(i.tangent + o.tangent) / wavelength[:, None]
        order_q = m / (self.tile * at.lateral_scale)
        step = wavelength[:, None] * order_q
        order_o = o.outer**2 - ((i.tangent + step) ** 2).sum(-1)
        order_i = i.outer**2 - ((o.tangent + step) ** 2).sum(-1)
        k_iz, k_oz = i.normal((i.square + order_i) / 2), o.normal((o.square + order_o) / 2)
        factor, _, _ = self.k_g(k_iz, k_oz, (step**2).sum(-1), i.inner, o.inner, reflects)
        # κ of reflected light is that of the pair, that of transmitted light that of the order.
        pair = i.sign * i.normal(i.square) + o.sign * o.normal(o.square)
        kappa = 2 * np.pi / wavelength * np.where(reflects, pair, i.sign * k_iz + o.sign * k_oz) * at.height_scale
        width = wavelength * self.sigma_q
        x_i = np.minimum(i.square, order_o * i.outer / o.outer) / (2 * i.outer * width)
        x_o = np.minimum(o.square, order_i * o.outer / i.outer) / (2 * o.outer * width)
        propagates = (order_i > 0) & (order_o > 0)
        v = np.sqrt((wavelength * np.linalg.norm(q, axis=-1)) ** 2 + pair**2)
        excess = np.where(reflects, 0, i.inner**2 - o.inner**2)
        i_h = np.minimum(np.abs(v**2 + excess) / (2 * v * i.inner), 1)
        reflected, transmitted = self.of_plane(i_h, i.sign > 0, wavelength, at)
        common = np.where(reflects, reflected, transmitted) * factor * gain(x_i) * gain(x_o) * propagates
        common = common * o.outer**2 / wavelength**2
        lobe = np.exp(-((q - order_q) ** 2).sum(-1) / (2 * self.sigma_q**2)) / (2 * np.pi * self.sigma_q**2)
        return common, self.eta(m, kappa), lobe, np.abs(kappa)

    def of_base(self, wi, wo, wavelength, at):
        """f of the base below the relief."""
        c, result = self.c, 1.0
        if c.base is None:
            return np.zeros(len(wi))
        for omega in (wi, wo):
            cos = omega[:, 2]
            if c.coat:
                cos = np.sqrt(1 - (1 - cos**2) * (c.outside / self.above(wavelength)) ** 2)
            result = result * self.of_plane(cos, True, wavelength, at)[1]
        return result * c.base / np.pi

    def albedo(self, omega, wavelength, at):
        """R and T of a direction (3,) outside without E."""
        totals = []
        for below in (False, True) if self.c.transmission != "none" else (False,):
            m, wo = self.orders(omega, wavelength, below, at)
            wi = np.repeat(omega[None], len(m), axis=0)
            common, eta, _, _ = self.terms(wi, wo, m, np.full(len(m), wavelength), at)
            outer, _ = self.indices(wo[:, 2] > 0, wavelength)
            totals.append((common * eta * wavelength**2 / outer**2).sum())
        return totals
