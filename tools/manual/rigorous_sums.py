"""Print R + T of rigorous tables of interfaces in random directions, for docs/materials.md."""

from __future__ import annotations

import numpy as np

import mitsuba_diffraction as md
from mitsuba_diffraction import gratings

COUNT = 2000


def triangle(period: float, depth: float) -> md.HeightField:
    """Return a symmetric triangular grating."""
    x = (np.arange(512) + 0.5) / 512
    return md.HeightField(depth * (1 - np.abs(2 * x - 1))[None], period / 512)


def main() -> None:
    surfaces = {
        "triangle 0.41 µm, 0.028 µm deep, n = 1.9": (triangle(0.41, 0.028), 1.9),
        "triangle 0.72 µm, 0.075 µm deep, n = 1.5": (triangle(0.72, 0.075), 1.5),
        "sinusoidal 0.64 µm, 0.24 µm deep, n = 1.33": (gratings.sinusoidal(0.64, 0.24), 1.33),
    }
    for name, (heights, index) in surfaces.items():
        table = md.precompute(heights, theory="rigorous", int_ior=index, transmission="interface")
        rng = np.random.default_rng(1)
        theta, phi = np.deg2rad(rng.uniform(0, 89.5, COUNT)), rng.uniform(0, 2 * np.pi, COUNT)
        omega = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        omega[::2, 2] *= -1
        sums = np.array(
            [
                sum(table.efficiencies(direction, wavelength, transmitted)[1].sum() for transmitted in (False, True))
                for direction, wavelength in zip(omega, rng.uniform(0.36, 0.83, COUNT), strict=True)
            ]
        )
        print(
            f"{name}: mean {sums.mean():.4f}, above 1.02 in {100 * (sums > 1.02).mean():.1f} %, maximum "
            f"{sums.max():.3f}; maximum error of the table {table.max_error:.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
