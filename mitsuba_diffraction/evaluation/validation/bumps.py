"""Equal bumps on equal tracks: a compact disc, of which scalar theory is known in closed form (Stam 1999).

Pits of width a, length b and depth d lie on tracks a distance t apart, so that with c = e^{−iκd} − 1 the phase is one
plus c in every pit. The transform of a pit is the one of a box, B(q) = ab sinc(a q_x) sinc(b q_y).

Regular: one pit for every stretch s of a track. Then there are orders only,

    η_m = |δ_m + c B(m_x/t, m_y/s)/(ts)|².

Random: along every track each stretch b holds a pit with the probability p. The mean field has the orders
of the tracks alone; the variance scatters light along them, between the orders of the tracks:

    S(q) = Σ_m |δ_m + cp · a/t · sinc(ma/t)|² δ(q_x − m/t) δ(q_y) + |c|² p(1 − p) |B(q)|²/(tb).

p is that of the drawn data. On pixels of size s, integrals are sums: sinc(aq) becomes sinc(aq)/sinc(sq).
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from ...grating_spectrum import GratingSpectrum
from ...settings import lobe_width
from ...surface.heightfield import HeightField
from ...testing import direction
from .analytic import compare_orders
from .lobes import density, grating, spectrum_of, towards
from .record import Check, Record

Array = NDArray[np.float64]

TRACK, WIDTH, LENGTH, DEPTH = 1.6, 0.6, 0.8, 0.12  # µm: t, a, b, d
STRETCH = 2.0  # µm: s
FINE, COARSE = 0.00625, 0.2  # µm, pixels; whole numbers of them fill every length
TRACKS, STRETCHES = 40, 80  # of the random disc
COHERENCE = 15.0  # µm
DEVIATIONS = 3.0


def regular() -> HeightField:
    """Return the heights of one pit, (N_y, N_x)."""
    columns, rows = round(TRACK / FINE), round(STRETCH / FINE)
    heights = np.zeros((rows, columns))
    heights[: round(LENGTH / FINE), : round(WIDTH / FINE)] = -DEPTH
    return HeightField(heights, FINE, "pits on a lattice")


@functools.cache
def data(seed: int = 0) -> NDArray[np.bool_]:
    """Draw the data: a mask of pits, (stretches, tracks)."""
    return np.random.default_rng(seed).random((STRETCHES, TRACKS)) < 0.5


def random() -> HeightField:
    """Return a piece of a disc with random data."""
    track = np.zeros(round(TRACK / COARSE))
    track[: round(WIDTH / COARSE)] = -DEPTH
    heights = np.kron(data(), np.ones((round(LENGTH / COARSE), 1)) * track)
    return HeightField(heights, COARSE, "random pits on tracks")


def _regular() -> Record:
    def closed_form(m: Array, kappa: Array) -> Array:
        pit = WIDTH * LENGTH * np.sinc(WIDTH * m[:, 0] / TRACK) * np.sinc(LENGTH * m[:, 1] / STRETCH)
        place = np.exp(-1j * np.pi * (m[:, 0] * WIDTH / TRACK + m[:, 1] * LENGTH / STRETCH))
        return np.abs((m == 0).all(axis=1) + _contrast(kappa) * pit * place / (TRACK * STRETCH)) ** 2

    return compare_orders(regular(), closed_form, azimuth=20.0)


def _contrast(kappa: Array) -> NDArray[np.complex128]:
    """Return c."""
    return np.exp(-1j * kappa * DEPTH) - 1


@functools.cache
def _spectrum() -> GratingSpectrum:
    return spectrum_of(random(), extent="sample", coherence_length=COHERENCE, tolerance=5e-3, largest_angle=26.0)


def _seen(q: Array, wavelength: float) -> tuple[Array, NDArray[np.complex128]]:
    """Return S as the BSDF shows it at normal incidence, and c of κ there."""
    wi = direction(0)
    wo = towards(wi, q, wavelength)
    kappa = 2 * np.pi * (1 + wo[..., 2]) / wavelength
    return density(grating(_spectrum(), conserve=False), wi, wo, wavelength), _contrast(kappa)


def _box(size: float, q: Array) -> Array:
    return size * np.sinc(size * q) / np.sinc(COARSE * q)


def _between(q: Array, c: Array) -> Array:
    pit = _box(WIDTH, q[..., 0]) * _box(LENGTH, q[..., 1])
    return np.abs(c) ** 2 * data().mean() * (1 - data().mean()) * pit**2 / (TRACK * LENGTH)


def _size() -> float:
    """Return the area (µm²) that Welch's windows weigh equally: their centres keep 3 σ_s from the edges."""
    margin = 6 * COHERENCE / 4
    return (TRACKS * TRACK - margin) * (STRETCHES * LENGTH - margin)


def _tracks(m: int) -> Record:
    """Compare the power of an order of the tracks, within 5 σ_q of q = (m/t, 0), without the incoherent part."""
    wavelength, sigma = 0.5, lobe_width(COHERENCE)
    axis = np.linspace(-5, 5, 41) * sigma
    q = np.stack(np.meshgrid(m / TRACK + axis, axis), axis=-1)
    s, c = _seen(q, wavelength)
    area = (axis[1] - axis[0]) ** 2
    between = _between(q, c)
    found = (s - between).sum() * area
    middle = c[20, 20]
    expected = np.abs((m == 0) + middle * data().mean() * _box(WIDTH, m / TRACK) / TRACK) ** 2
    # The mean over the piece differs from the mean by a number of variance S/A; half of it is along the field. Of the
    # incoherent part, a band B holds A·B independent speckles.
    size = _size()
    noise = np.hypot(
        2 * np.sqrt(expected * between[20, 20] / 2 / size), between.sum() * area / np.sqrt(size * (10 * sigma) ** 2)
    )
    bound = DEVIATIONS * noise + _spectrum().tolerance
    return Record(found, expected, bound, note="share of the light")


def _between_tracks() -> Record:
    """Compare the incoherent part in a band between the orders of the tracks, 0.2 to 0.5 by −0.7 to 0.7 cycles/µm."""
    wavelength = 0.5
    x, y = np.linspace(0.2, 0.5, 31), np.linspace(-0.7, 0.7, 141)
    q = np.stack(np.meshgrid(x, y), axis=-1)
    s, c = _seen(q, wavelength)
    area = (x[1] - x[0]) * (y[1] - y[0])
    expected, found = _between(q, c).sum() * area, s.sum() * area
    size = _size()
    bound = DEVIATIONS * expected / np.sqrt(size * 0.3 * 1.4) + _spectrum().tolerance * expected
    return Record(found, expected, bound, note="share of the light")


CHECKS = (
    Check("analytic", "equal bumps on a lattice", _regular, "Stam 1999: transform of one bump, sampled by the lattice"),
    Check("statistical", "compact disc, random pits: mirror order", lambda: _tracks(0), "Stam 1999", slow=True),
    Check("statistical", "compact disc, random pits: first order", lambda: _tracks(1), "Stam 1999", slow=True),
    Check("statistical", "compact disc, random pits: between orders", _between_tracks, "Stam 1999", slow=True),
)
