"""Synthetic replica of the shed skin of Xenopeltis unicolor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from ..heightfield import HeightField
from .canvas import Canvas, smooth_step
from .checks import check_profile, generator


def xenopeltis(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.443,
    period: float = 1.552,
    seed: int = 0,
) -> HeightField:
    """Synthetic replica of the shed skin of *Xenopeltis unicolor*, not a measurement.

    Rows of short round fingers, which point along +x and rise towards their tips like roof tiles. Rows run along y, one
    period apart along **x**, the diffracting direction; they meander by 10 to 20 degrees and occasionally fork or end.
    Fingers are 0.36 periods apart along y, with small deep pits between them; some are joined. The shape is modelled on
    a 5.9 µm AFM scan of the LANE lab, Geneva.

    The patch tiles seamlessly: size_x is rounded to whole periods, and the pitch of the fingers is adjusted to size_y.

    Args:
        size: approximate size of the patch, µm, one number or (x, y).
        pixel_size: µm, adjusted to a whole number of pixels per patch.
        depth: lowest to highest point, µm.
        period: mean distance from row to row along x, µm.
        seed: random seed.

    Returns:
        The patch, (round(size_y / pixel_size), round(size_x / pixel_size)).

    Raises:
        ValueError: if a length is not positive, the depth negative, the seed not a natural number, the size below two
            rows or four fingers, or the pixels too coarse for the fingers.
    """
    check_profile(period, depth)
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(period, 0.36 * period), axis=0)
    row_pitch, pitch = canvas.pitch

    meander = 0.11 * row_pitch * canvas.noise(rng, 6.0, 1.3)
    faults = _faults(canvas, rng)
    rows = [(x, None) for x in canvas.places(0)] + [(fault.x, fault) for fault in faults if fault.extra]
    grooves, tips = [], []
    for x, own in rows:
        # Every row has a phase of its own, and a finger more or less than its neighbours where there are many.
        count = canvas.count[1] + round(rng.normal(0, 0.012 * canvas.count[1]))
        row_phase = rng.uniform()
        for index in range(count):
            y = (index + row_phase + rng.normal(0, 0.09)) * canvas.size[1] / count
            if not _present(faults, own, x, y, canvas):
                continue
            x_0 = x + _fault_shift(faults, x, y, canvas)
            x_0 += canvas.at(meander, x_0, y)
            length = row_pitch * (1 + rng.normal(0, 0.05))
            tips.append((x_0, y, length))
            grooves.append((x_0, y + pitch / 2, length))
    for x_0, y_0, length in tips:
        _xenopeltis_finger(canvas, rng, x_0, y_0, length)
    for x_0, y_0, length in grooves:
        _xenopeltis_pit(canvas, rng, x_0, y_0, length)
    canvas.heights += 0.005 * canvas.noise(rng, 0.07, 0.04) + 0.006 * canvas.noise(rng, 1.0, 1.0)
    return canvas.height_field(
        rng,
        depth,
        f"synthetic Xenopeltis skin, {canvas.count[0]} rows of {row_pitch:.4g} µm along x, "
        f"fingers of {pitch:.3g} µm along y, depth {depth:g} µm, seed {seed}",
    )


@dataclass(frozen=True)
class _Fault:
    """A stretch along y where there is a row more or a row less: rows fork or join at its ends.

    Attributes:
        x, y: centre, µm.
        half: half the length along y, µm.
        extra: True for a row more, False for a row less.
    """

    x: float
    y: float
    half: float
    extra: bool

    def weight(self, y: float, size_y: float) -> float:
        """1 inside the fault, 0 outside, smooth at its ends."""
        d = _wrapped(y - self.y, size_y)
        return float((erf((d + self.half) / 1.2) - erf((d - self.half) / 1.2)) / 2)


def _wrapped(distance: float, size: float) -> float:
    """Shortest distance on a circle of circumference `size`."""
    return (distance + size / 2) % size - size / 2


def _faults(canvas: Canvas, rng: np.random.Generator) -> list[_Fault]:
    """Faults apart from each other, about one per 200 µm²; as many rows more as less, so that the mean pitch stays."""
    row_pitch = canvas.pitch[0]
    faults: list[_Fault] = []
    wanted = 2 * round(canvas.size[0] * canvas.size[1] / 400)
    for _ in range(20 * wanted):
        if len(faults) == wanted:
            break
        extra = len(faults) % 2 == 0
        # A row more lies between two rows, a row less in the place of one.
        x = (rng.integers(canvas.count[0]) + (1.0 if extra else 0.5)) * row_pitch % canvas.size[0]
        fault = _Fault(x, rng.uniform(0, canvas.size[1]), rng.uniform(1.5, 3.0), extra)
        if all(
            abs(_wrapped(x - other.x, canvas.size[0])) > 3.2 * row_pitch
            or abs(_wrapped(fault.y - other.y, canvas.size[1])) > fault.half + other.half + 2.5
            for other in faults
        ):
            faults.append(fault)
    return faults[: len(faults) // 2 * 2]


def _present(faults: list[_Fault], own: _Fault | None, x: float, y: float, canvas: Canvas) -> bool:
    """Whether the row at x has a finger at y; `own` is the fault that made the row, if one did."""
    if own is not None:
        return own.weight(y, canvas.size[1]) > 0.5
    return all(
        fault.extra
        or abs(_wrapped(x - fault.x, canvas.size[0])) > canvas.pitch[0] / 4
        or fault.weight(y, canvas.size[1]) < 0.5
        for fault in faults
    )


def _fault_shift(faults: list[_Fault], x: float, y: float, canvas: Canvas) -> float:
    """How far the faults push the row at x along x, µm: away from a row more, towards a row less."""
    row_pitch = canvas.pitch[0]
    shift = 0.0
    for fault in faults:
        d = _wrapped(x - fault.x, canvas.size[0])
        nearest, sign = (row_pitch / 2, 1.0) if fault.extra else (row_pitch, -1.0)
        decay = np.exp(-max(abs(d) - nearest, 0.0) / (3 * row_pitch))
        shift += sign * np.sign(d) * row_pitch / 2 * decay * fault.weight(y, canvas.size[1])
    return float(shift)


def _xenopeltis_finger(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """A finger that rises from its root at x_0 to a round tip; the higher of it and what is there stays."""
    pitch = canvas.pitch[1]
    # Some are swollen and join their neighbour.
    swollen = rng.uniform() < 0.1
    top = rng.uniform(0.08, 0.12) if swollen else rng.uniform(0.05, 0.11)
    width = 0.75 if swollen else 0.5 + rng.normal(0, 0.05)
    tilt = rng.normal(0.03, 0.06) * pitch / length
    index, x, y = canvas.window((x_0 - 0.1 * length, x_0 + 1.2 * length), (y_0 - 1.4 * pitch, y_0 + 1.4 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    cap = np.sqrt(np.clip(1 - np.clip((s - 0.75) / 0.25, 0, None) ** 2, 0, 1))
    taper = 0.1 if swollen else 0.4
    half = width * (1 - taper * np.clip(s, 0, 1)) * cap
    finger = top * np.clip(s, 0, 1) ** 1.2 * smooth_step(half - np.abs(t), 0.17) * (1 - smooth_step(s - 1, 0.035))
    canvas.heights[index] = np.maximum(canvas.heights[index], finger)
    # Debris sticks to a few tips, as the scan shows.
    if rng.uniform() < 0.03:
        radius = rng.uniform(0.06, 0.13)
        debris = np.exp(-(((x - x_0) - 0.93 * length) ** 2 + (y - y_0) ** 2) / radius**2)
        canvas.heights[index] += rng.uniform(0.04, 0.1) * debris


def _xenopeltis_pit(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """The pit between two fingers, deepest near their roots."""
    pitch = canvas.pitch[1]
    depth = rng.uniform(0.01, 0.03) if rng.uniform() < 0.1 else rng.uniform(0.04, 0.11)
    start = 0.1 + rng.normal(0, 0.04)
    reach = rng.uniform(0.55, 0.8)
    width = 0.17 * rng.uniform(0.7, 1.3)
    tilt = rng.normal(0.03, 0.06) * pitch / length
    index, x, y = canvas.window((x_0, x_0 + 1.1 * length), (y_0 - 0.9 * pitch, y_0 + 0.9 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    u = np.clip((s - start) / reach, 0, 1)
    half = width * 2 * np.sqrt(u * (1 - u))  # an ellipse
    pit = smooth_step(half - np.abs(t), 0.12) * smooth_step(s - start - 0.03, 0.04) * (1 - u) ** 0.7
    canvas.heights[index] -= depth * pit
