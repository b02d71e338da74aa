"""Speed of evaluation and sampling of BSDFs, as ratios to Mitsuba's roughconductor in the same run."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from importlib import metadata
from pathlib import Path
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ...bsdf.device_tables import on_device
from ...bsdf.testing import interaction, vectors
from ...settings import VISIBLE

Name = TypeVar("Name", bound=Hashable)


class Rays:
    """Random pairs of directions, each with four random wavelengths, and random numbers for sampling."""

    def __init__(self, count: int) -> None:
        random = np.random.default_rng(0)
        self.count = count
        wi, wo = (_directions(random, count) for _ in range(2))
        self.si, self.wo = interaction(wi, random.uniform(*VISIBLE, (4, count)).T), vectors(wo)
        self.sample1 = on_device(random.random(count))
        self.sample2 = mi.Point2f(*map(on_device, random.random((2, count))))
        dr.eval(self.si, self.wo, self.sample1, self.sample2)

    def evaluate(self, bsdf: mi.BSDF) -> None:
        """Evaluate `eval_pdf` of all rays."""
        dr.eval(bsdf.eval_pdf(mi.BSDFContext(), self.si, self.wo))

    def sample(self, bsdf: mi.BSDF) -> None:
        """Sample all rays."""
        sample, weight = bsdf.sample(mi.BSDFContext(), self.si, self.sample1, self.sample2)
        dr.eval(sample.wo, sample.pdf, weight)


def _directions(random: np.random.Generator, count: int) -> np.ndarray:
    z, azimuth = random.uniform(0, 1, count), random.uniform(0, 2 * np.pi, count)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


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


def machine() -> dict[str, object]:
    """Return what speeds depend on: the processor, the cores of this process, the variant and the versions."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "variant": mi.variant(),
        **{name: metadata.version(name) for name in ("mitsuba", "drjit", "mitsuba-diffraction")},
    }
