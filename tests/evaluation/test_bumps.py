"""Equal bumps on equal tracks: a compact disc, whose scalar theory has a closed form (Stam 1999).

Pits of width a, length b and depth d lie on tracks of pitch t, so that with c = e^{−iκd} − 1 the phase factor e^{iκh}
is 1 outside the pits and 1 + c in them. The transform of a pit is that of a box, B(q) = ab sinc(a q_x) sinc(b q_y).

Regular: one pit per length s of a track. Then there are only orders,

    η_m = |δ_m + c B(m_x/t, m_y/s)/(ts)|².

Random: each length b of a track has a pit with probability p. The mean field has only the orders of the tracks; the
variance scatters light between these orders:

    S(q) = Σ_m |δ_m + cp · a/t · sinc(ma/t)|² δ(q_x − m/t) δ(q_y) + |c|² p(1 − p) |B(q)|²/(tb).

p is the fraction of pits in the drawn data. On pixels of size Δ, integrals are sums: sinc(aq) becomes
sinc(aq)/sinc(Δq).
"""

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from mitsuba_diffraction.bsdf.testing import direction, towards
from mitsuba_diffraction.evaluation.record import Record
from mitsuba_diffraction.evaluation.validation.analytic import compare_orders
from mitsuba_diffraction.evaluation.validation.lobes import density, grating, spectrum_of
from mitsuba_diffraction.precomputation.grating_spectrum import GratingSpectrum
from mitsuba_diffraction.settings import lobe_width
from mitsuba_diffraction.surface.heightfield import HeightField

Array = NDArray[np.float64]

TRACK_PITCH, PIT_WIDTH, PIT_LENGTH, PIT_DEPTH = 1.6, 0.6, 0.8, 0.12  # µm: t, a, b, d
PIT_SPACING = 2.0  # µm: s
FINE_PIXEL, COARSE_PIXEL = 0.00625, 0.2  # µm; all lengths are multiples
TRACK_COUNT, PITS_PER_TRACK = 40, 80  # of the random disc
COHERENCE_LENGTH = 15.0  # µm
MAX_DEVIATIONS = 3.0


def regular() -> HeightField:
    """Return the heights of one pit, (N_y, N_x)."""
    columns, rows = round(TRACK_PITCH / FINE_PIXEL), round(PIT_SPACING / FINE_PIXEL)
    heights = np.zeros((rows, columns))
    heights[: round(PIT_LENGTH / FINE_PIXEL), : round(PIT_WIDTH / FINE_PIXEL)] = -PIT_DEPTH
    return HeightField(heights, FINE_PIXEL, "pits on a lattice")


@functools.cache
def data() -> NDArray[np.bool_]:
    """Draw the data: a mask of pits, (pits per track, tracks)."""
    return np.random.default_rng(0).random((PITS_PER_TRACK, TRACK_COUNT)) < 0.5


def random() -> HeightField:
    """Return a piece of a disc with random data."""
    track = np.zeros(round(TRACK_PITCH / COARSE_PIXEL))
    track[: round(PIT_WIDTH / COARSE_PIXEL)] = -PIT_DEPTH
    heights = np.kron(data(), np.ones((round(PIT_LENGTH / COARSE_PIXEL), 1)) * track)
    return HeightField(heights, COARSE_PIXEL, "random pits on tracks")


def regular_orders() -> Record:
    def closed_form(m: Array, kappa: Array) -> Array:
        x, y = m[:, 0] * PIT_WIDTH / TRACK_PITCH, m[:, 1] * PIT_LENGTH / PIT_SPACING
        pit = PIT_WIDTH * PIT_LENGTH * np.sinc(x) * np.sinc(y) * np.exp(-1j * np.pi * (x + y))
        return np.abs((m == 0).all(axis=1) + _contrast(kappa) * pit / (TRACK_PITCH * PIT_SPACING)) ** 2

    return compare_orders(regular(), closed_form, azimuth=20.0)


def _contrast(kappa: Array) -> NDArray[np.complex128]:
    """Return c."""
    return np.exp(-1j * kappa * PIT_DEPTH) - 1


@functools.cache
def _spectrum() -> GratingSpectrum:
    return spectrum_of(random(), extent="sample", coherence_length=COHERENCE_LENGTH, tolerance=5e-3, largest_angle=26.0)


def _measured_density(q: Array, wavelength: float) -> tuple[Array, NDArray[np.complex128]]:
    """Return S from the BSDF at normal incidence, and c at the same κ."""
    wi = direction(0)
    wo = towards(wi, q, 1e3 * wavelength)
    kappa = 2 * np.pi * (1 + wo[..., 2]) / wavelength
    return density(grating(_spectrum(), conserve=False), wi, wo, wavelength), _contrast(kappa)


def _box(size: float, q: Array) -> Array:
    return size * np.sinc(size * q) / np.sinc(COARSE_PIXEL * q)


def _incoherent_density(q: Array, c: Array) -> Array:
    pit = _box(PIT_WIDTH, q[..., 0]) * _box(PIT_LENGTH, q[..., 1])
    return np.abs(c) ** 2 * data().mean() * (1 - data().mean()) * pit**2 / (TRACK_PITCH * PIT_LENGTH)


def _effective_area() -> float:
    """Return the area (µm²) over which Welch's windows have equal weight: their centres are 3 σ_s inside the edges."""
    margin = 6 * COHERENCE_LENGTH / 4
    return (TRACK_COUNT * TRACK_PITCH - margin) * (PITS_PER_TRACK * PIT_LENGTH - margin)


def tracks(m: int) -> Record:
    """Compare the power of an order of the tracks, within 5 σ_q of q = (m/t, 0), without the incoherent part."""
    wavelength, sigma = 0.5, lobe_width(COHERENCE_LENGTH)
    axis = np.linspace(-5, 5, 41) * sigma
    q = np.stack(np.meshgrid(m / TRACK_PITCH + axis, axis), axis=-1)
    s, c = _measured_density(q, wavelength)
    area = (axis[1] - axis[0]) ** 2
    between = _incoherent_density(q, c)
    found = (s - between).sum() * area
    c_centre = c[20, 20]
    expected = np.abs((m == 0) + c_centre * data().mean() * _box(PIT_WIDTH, m / TRACK_PITCH) / TRACK_PITCH) ** 2
    # The mean field over an area A differs from its expectation by a random number of variance S/A, half of it in phase
    # with the field. In a frequency band of area B, the incoherent part has A·B independent speckles.
    size = _effective_area()
    noise = np.hypot(
        2 * np.sqrt(expected * between[20, 20] / 2 / size), between.sum() * area / np.sqrt(size * (10 * sigma) ** 2)
    )
    bound = MAX_DEVIATIONS * noise + _spectrum().tolerance
    return Record(found, expected, bound, note="fraction of the reflected power")


def between_tracks() -> Record:
    """Compare the incoherent part in a band between the orders of the tracks, 0.2 to 0.5 by −0.7 to 0.7 cycles/µm."""
    wavelength = 0.5
    x, y = np.linspace(0.2, 0.5, 31), np.linspace(-0.7, 0.7, 141)
    q = np.stack(np.meshgrid(x, y), axis=-1)
    s, c = _measured_density(q, wavelength)
    area = (x[1] - x[0]) * (y[1] - y[0])
    expected, found = _incoherent_density(q, c).sum() * area, s.sum() * area
    size = _effective_area()
    bound = MAX_DEVIATIONS * expected / np.sqrt(size * 0.3 * 1.4) + _spectrum().tolerance * expected
    return Record(found, expected, bound, note="fraction of the reflected power")


def test_equal_bumps_on_a_lattice_have_the_orders_of_one_bump(llvm):
    assert regular_orders().ok


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 1])
def test_random_pits_have_the_orders_of_their_tracks(llvm, order):
    assert tracks(order).ok


@pytest.mark.slow
def test_random_pits_scatter_between_the_orders(llvm):
    assert between_tracks().ok
