"""Tables of line gratings, by NumPy alone: the orders are the Fourier series of exp(iκh)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

PROFILES = {"sinusoidal": "Sinusoidal grating", "blazed": "Blazed grating", "lamellar": "Lamellar grating"}
_SAMPLES = 1024  # of a period
_MAX_HEIGHT_SCALE = 2.0
_SLICES = 65  # of κ
_LOBE_WIDTH = 0.0069  # cycles/µm, of a coherence length of 65 µm: as wide as the sun


def line_grating(
    profile: str, period: float, depth: float, duty: float, base: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the tables of a grating of this period and depth, µm; wavelengths, colours and index are those of `base`.

    Args:
        profile: one of `PROFILES`.
        duty: of a lamellar grating, the width of the ridges relative to the period.
    """
    x = np.arange(_SAMPLES) / _SAMPLES
    heights = depth * {"sinusoidal": 0.5 * np.sin(2 * np.pi * x), "blazed": x, "lamellar": 1.0 * (x < duty)}[profile]
    shortest = float(base["edges"][0])
    max_kappa = _MAX_HEIGHT_SCALE * 4 * np.pi / shortest
    last = int(2 * period / shortest)
    orders = np.arange(-last, last + 1)
    kappas = np.linspace(0, max_kappa, _SLICES)[:, None]
    powers = np.abs(np.fft.fft(np.exp(1j * kappas * heights), axis=1) / _SAMPLES) ** 2
    return {
        **{name: base[name] for name in ("edges", "colours", "spaces", "index")},
        "frequencies": np.column_stack([orders / period, 0 * orders]),
        "powers": powers[:, orders].T,
        "max_kappa": np.array(max_kappa),
        "max_height_scale": np.array(_MAX_HEIGHT_SCALE),
        "lobe_width": np.array(_LOBE_WIDTH),
    }
