"""Compares the program of Yan et al. 2018 with this model: `python tools/data/yan_2018.py GENBRDF`.

GENBRDF is the program that github.com/lingqi/WaveOpticsBrdf builds (with Eigen and OpenEXR; with Eigen 3.4 its types
Vector2 and Vector3 need other names). It reads heights in units of a texel, in half precision, of a square whose side
is a power of two (of another it leaves out a part), and returns the BRDF of a perfect mirror at one place of it, seen
through a Gaussian window: |∫ a e^{iκh} e^{−2πi q·x} dx|²/λ², with `RGHS` times (cos θ_i + cos θ_o)²/(4 cos θ_i
cos θ_o). It sums Gabor kernels, one for each texel, with the slope there; here the same integral is summed pixel by
pixel in float64, and is averaged over the places as S(q; κ) is.

Printed for each skin, wavelength and angle of incidence: the correlation of both pictures, Σ|Δ|/Σ over the directions,
for the mean over the places, and the ratio of their sums.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenEXR

from mitsuba_diffraction.precomputation.recipe import Recipe

ROOT = Path(__file__).parents[2]
SIDE, SIGMA, RESOLUTION = 256, 1.5, 24  # pixels; µm, of the window; pixels of a picture
PLACES = ((0.45, 0.45), (0.55, 0.6))  # fractions of the side
ROWS = (("elaphe", 0.5, 0), ("elaphe", 0.65, 0), ("elaphe", 0.55, 30), ("xenopeltis", 0.5, 0), ("xenopeltis", 0.55, 30))


def heights_of(skin):
    """A square of the prepared scan, µm, from its mean, and its pixel size."""
    field = Recipe.load(ROOT / "precompute" / f"{skin}.toml").height_field()
    part = field.heights[400 : 400 + SIDE, 400 : 400 + SIDE]
    return part - part.mean(), field.pixel_size[0]


def by_program(program, heights, pixel, wavelength, angle, folder):
    """The mean picture of their program, [u, v]: its first axis is that of the rows of its height field."""
    channels = {name: (heights / pixel).astype(np.float16) for name in "RGB"}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(folder / "heights.exr"))
    pictures = []
    for x, y in PLACES:
        words = [program, "-m", "Wave", "-d", "RGHS", "-i", folder / "heights.exr", "-o", folder / "brdf.exr"]
        words += ["-w", pixel, "-l", wavelength, "-p", SIGMA, "-r", RESOLUTION, "-s", np.tan(np.deg2rad(angle))]
        words += ["-x", x * SIDE * pixel, "-y", y * SIDE * pixel]
        subprocess.run([str(word) for word in words], check=True, capture_output=True)
        with OpenEXR.File(str(folder / "brdf.exr"), separate_channels=True) as file:
            pictures.append(file.channels()["R"].pixels.astype(np.float64))
    return np.mean(pictures, axis=0)


def by_sum(heights, pixel, wavelength, angle):
    """The same, summed in float64."""
    axis = (np.arange(RESOLUTION) + 0.5) / RESOLUTION * 2 - 1
    incident = np.sin(np.deg2rad(angle))
    at = (np.arange(SIDE) + 0.5) * pixel
    picture = np.zeros((RESOLUTION, RESOLUTION))
    for i, j in np.ndindex(picture.shape):
        square = 1 - axis[i] ** 2 - axis[j] ** 2
        if square <= 0:
            continue
        c_i, c_o = np.cos(np.deg2rad(angle)), np.sqrt(square)
        kappa = 2 * np.pi * (c_i + c_o) / wavelength
        # The field of a facet of slope s is strongest where omega_i + omega_o = -(c_i + c_o) s.
        phase = 2 * np.pi / wavelength * (axis[i] + incident) * at[:, None] + 2 * np.pi / wavelength * axis[j] * at
        wave = np.exp(1j * (kappa * heights + phase))
        for x, y in PLACES:
            u, v = (np.exp(-((at - f * SIDE * pixel) ** 2) / (2 * SIGMA**2)) for f in (x, y))
            amplitude = (u @ wave @ v) * pixel**2 / (np.sqrt(np.pi) * SIGMA)
            picture[i, j] += np.abs(amplitude) ** 2 / wavelength**2 * (c_i + c_o) ** 2 / (4 * c_i * c_o)
    return picture / len(PLACES)


def main(program):
    for skin, wavelength, angle in ROWS:
        heights, pixel = heights_of(skin)
        with tempfile.TemporaryDirectory() as folder:
            theirs = by_program(program, heights, pixel, wavelength, angle, Path(folder))
        ours = by_sum(heights, pixel, wavelength, angle)
        inside = ours > 0
        correlation = np.corrcoef(theirs[inside], ours[inside])[0, 1]
        difference = np.abs(theirs - ours)[inside].sum() / ours.sum()
        ratio = theirs[inside].sum() / ours.sum()
        print(f"{skin} {1e3 * wavelength:.0f} nm {angle}°: {correlation:.4f} {difference:.3f} {ratio:.3f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
