"""How fast BSDFs evaluate and sample, as ratios to Mitsuba's roughconductor in the same run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from ..spectrum import GratingSpectrum


class Rays:
    """Random directions, each with four random wavelengths, and random numbers to sample from."""

    def __init__(self, count: int, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self.count = count
        self.wi, self.wo = self._directions(random), self._directions(random)
        self.wavelengths = mi.UnpolarizedSpectrum(*(mi.Float(random.uniform(360, 830, count)) for _ in range(4)))
        self.sample1 = mi.Float(random.random(count))
        self.sample2 = mi.Point2f(mi.Float(random.random(count)), mi.Float(random.random(count)))
        dr.eval(self.wi, self.wo, self.wavelengths, self.sample1, self.sample2)

    def _directions(self, random: np.random.Generator) -> mi.Vector3f:
        z, azimuth = random.uniform(0, 1, self.count), random.uniform(0, 2 * np.pi, self.count)
        radius = np.sqrt(1 - z**2)
        return mi.Vector3f(mi.Float(radius * np.cos(azimuth)), mi.Float(radius * np.sin(azimuth)), mi.Float(z))

    def _interaction(self) -> mi.SurfaceInteraction3f:
        si = dr.zeros(mi.SurfaceInteraction3f, self.count)
        si.wi, si.wavelengths = self.wi, self.wavelengths
        return si

    def evaluate(self, bsdf: mi.BSDF) -> None:
        """eval_pdf of all."""
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), self._interaction(), self.wo)
        dr.eval(value, pdf)
        dr.sync_thread()

    def sample(self, bsdf: mi.BSDF) -> None:
        """sample of all."""
        sample, weight = bsdf.sample(mi.BSDFContext(), self._interaction(), self.sample1, self.sample2)
        dr.eval(sample.wo, sample.pdf, weight)
        dr.sync_thread()

    def read(self, spectrum: GratingSpectrum, table: mi.Float) -> None:
        """What no evaluation can do without: the packets of four floats about each q, gathered and added up.

        Args:
            spectrum: says which nodes and how many packets.
            table: of the size of the spectrum's table at run time, at least.
        """
        q_x, q_y = spectrum.grid.frequencies()
        largest_x, largest_y = spectrum.grid.largest
        spacing_x, spacing_y = (mi.Float(_spacing(q)) for q in (q_x, q_y))
        dr.make_opaque(spacing_x, spacing_y)
        rows, columns = spectrum.grid.shape
        count_x, count_y = spectrum.neighbours
        packets = -(-spectrum.table.floats_per_node // 4)
        result = mi.UnpolarizedSpectrum(0.0)
        for channel in range(len(result)):
            wavelength = self.wavelengths[channel] * 1e-3
            m_x = mi.Int32(dr.round((self.wi.x + self.wo.x) / (wavelength * spacing_x)))
            m_y = mi.Int32(dr.round((self.wi.y + self.wo.y) / (wavelength * spacing_y)))
            inside = (dr.abs(m_x) <= largest_x) & (dr.abs(m_y) <= largest_y)
            node = mi.UInt32(dr.select(inside, (m_y + largest_y) * columns + m_x + largest_x, 0))
            total = mi.Vector4f(0.0)
            for packet in range(packets):
                for i, j in np.ndindex(count_y, count_x):
                    near = dr.minimum(node + i * columns + j, rows * columns - 1)
                    total += dr.gather(mi.Vector4f, table, near + packet * (rows * columns), inside)
            result[channel] = dr.sum(total)
        dr.eval(result)
        dr.sync_thread()


def _spacing(q: np.ndarray) -> float:
    return float(q[1] - q[0]) if len(q) > 1 else 1.0


def rates(rays: Rays, work: Mapping[str, Callable[[], None]], repetitions: int) -> dict[str, float]:
    """Calls of each per second and ray: medians of interleaved repetitions, so that all share the machine's moods."""
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for call in work.values():
        call()  # compiles
    for _ in range(repetitions):
        for name, call in work.items():
            start = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - start)
    return {name: rays.count / statistics.median(times) for name, times in seconds.items()}
