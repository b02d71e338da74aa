"""Speed of evaluation and sampling of BSDFs, as ratios to Mitsuba's roughconductor in the same run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ...grating_spectrum import GratingSpectrum
from ...settings import VISIBLE
from ...testing import interaction, vectors

Name = TypeVar("Name", bound=Hashable)


class Rays:
    """Random pairs of directions, each with four random wavelengths, and random numbers for sampling."""

    def __init__(self, count: int) -> None:
        random = np.random.default_rng(0)
        self.count = count
        wi, wo = (_directions(random, count) for _ in range(2))
        self.si, self.wo = interaction(wi, random.uniform(*VISIBLE, (4, count)).T), vectors(wo)
        self.sample1 = mi.Float(random.random(count))
        self.sample2 = mi.Point2f(mi.Float(random.random(count)), mi.Float(random.random(count)))
        dr.eval(self.si, self.wo, self.sample1, self.sample2)

    def evaluate(self, bsdf: mi.BSDF) -> None:
        """Evaluate `eval_pdf` of all rays."""
        dr.eval(bsdf.eval_pdf(mi.BSDFContext(), self.si, self.wo))

    def sample(self, bsdf: mi.BSDF) -> None:
        """Sample all rays."""
        sample, weight = bsdf.sample(mi.BSDFContext(), self.si, self.sample1, self.sample2)
        dr.eval(sample.wo, sample.pdf, weight)

    def read(self, spectrum: GratingSpectrum, table: mi.UInt32) -> None:
        """Sum the words of the nodes around each q: the minimum work of any evaluation.

        Args:
            spectrum: determines the nodes and the number of words.
            table: of `blank(spectrum)`.
        """
        q_x, q_y = spectrum.grid.frequencies()
        max_x, max_y = spectrum.grid.max_order
        spacing_x, spacing_y = (mi.Float(float(q[1] - q[0]) if len(q) > 1 else 1.0) for q in (q_x, q_y))
        dr.make_opaque(spacing_x, spacing_y)
        rows, columns = spectrum.grid.shape
        count_x, count_y = spectrum.neighbours
        words = spectrum.table.words_per_node
        packet, packets = (mi.UInt32, words) if words < 4 else (mi.Vector4u, words // 4)
        wi = self.si.wi
        result = mi.UnpolarizedSpectrum(0.0)
        for channel in range(len(result)):
            wavelength = self.si.wavelengths[channel] * 1e-3
            m_x = mi.Int32(dr.round((wi.x + self.wo.x) / (wavelength * spacing_x)))
            m_y = mi.Int32(dr.round((wi.y + self.wo.y) / (wavelength * spacing_y)))
            inside = (dr.abs(m_x) <= max_x) & (dr.abs(m_y) <= max_y)
            node = mi.UInt32(dr.select(inside, (m_y + max_y) * columns + m_x + max_x, 0))
            total = packet(0)
            for i, j in np.ndindex(count_y, count_x):
                near = dr.minimum(node + i * columns + j, rows * columns - 1)
                for part in range(packets):
                    total += dr.gather(packet, table, packets * near + part, inside)
            result[channel] = mi.Float(dr.sum(total))
        dr.eval(result)


def _directions(random: np.random.Generator, count: int) -> np.ndarray:
    z, azimuth = random.uniform(0, 1, count), random.uniform(0, 2 * np.pi, count)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


def blank(spectrum: GratingSpectrum) -> mi.UInt32:
    """Return zeros, as many as the words of a spectrum's table for one κ at run time."""
    words = dr.zeros(mi.UInt32, int(np.prod(spectrum.grid.shape)) * spectrum.table.words_per_node)
    dr.make_opaque(words)
    return words


def seconds(
    work: Mapping[Name, Callable[[], object]], repetitions: int, clock: Callable[[], float] = time.perf_counter
) -> dict[Name, float]:
    """Return seconds per call: medians of interleaved repetitions, so that all calls see the same machine load."""
    times: dict[Name, list[float]] = {name: [] for name in work}
    for repetition in range(-1, repetitions):  # the first compiles
        for name, call in work.items():
            start = clock()
            call()
            dr.sync_thread()
            if repetition >= 0:
                times[name].append(clock() - start)
    return {name: statistics.median(values) for name, values in times.items()}
