"""Synthetic replicas of snake skins, drawn with the periods that were measured: *Elaphe* and *Xenopeltis*."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from ..array_types import Real
from .drawing import Canvas, check_profile, generator, smooth_step
from .heightfield import HeightField


def elaphe_synthetic(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.375,
    period: float = 1.144,
    seed: int = 0,
) -> HeightField:
    """Draw a synthetic replica of the shed skin of *Elaphe guttata*, not a measurement.

    Fingers along x that taper towards +x, side by side along **y**, the diffracting direction. Between two fingers a
    groove starts as a deep narrow crotch and widens up to the tips of the fingers, where the next row begins, 2.93
    periods further on. Granules sit on top of the fingers. Positions, lengths, widths, heights and tilts vary from
    finger to finger as in AFM scans of such skins. The shape is modelled on a 5.9 µm AFM scan of the LANE lab, Geneva.

    `period` is the mean distance from finger to finger. size_y is rounded to whole periods, and the pitch of the rows
    is adjusted to size_x; the patch holds at least two rows and four fingers.
    """
    check_profile(period, depth)
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(2.93 * period, period), axis=1)
    row_pitch, pitch = canvas.pitch

    # The lattice of crotches: it drifts slowly, rows shift against each other, and every crotch is displaced.
    drift_x = 0.08 * row_pitch * canvas.noise(rng, 8.0, 4.0)
    drift_y = 0.12 * pitch * canvas.noise(rng, 8.0, 8.0)
    granules = np.zeros_like(canvas.heights)
    for x, row_shift in zip(canvas.centres(0), rng.normal(0, 0.05 * pitch, canvas.count[0]), strict=True):
        for y in canvas.centres(1):
            x_0 = x + canvas.value_at(drift_x, x, y) + rng.normal(0, 0.04 * row_pitch)
            y_0 = y + canvas.value_at(drift_y, x, y) + row_shift + rng.normal(0, 0.035 * pitch)
            _elaphe_groove(canvas, rng, x_0, y_0)
            _elaphe_tip(canvas, rng, x_0, y_0 + pitch / 2)
            _elaphe_granules(canvas, granules, rng, x_0, y_0 + pitch / 2)
    # Fibrils run along the fingers; the rest is roughness.
    canvas.heights += granules
    canvas.heights += 0.005 * canvas.noise(rng, 0.3, 0.04) + 0.008 * canvas.noise(rng, 1.5, 0.7)
    return canvas.height_field(
        rng,
        depth,
        f"synthetic Elaphe skin, {canvas.count[1]} fingers of {pitch:.4g} µm along y, "
        f"{canvas.count[0]} rows of {row_pitch:.4g} µm along x, depth {depth:g} µm, seed {seed}",
    )


# Heights in µm as they were read off the mean unit cell of the AFM patch; the patch is scaled to `depth` at the end.


def _elaphe_groove(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """Draw the groove between two fingers, from its crotch at (x_0, y_0) along +x."""
    row_pitch, pitch = canvas.pitch
    length = row_pitch * (0.97 + rng.normal(0, 0.035))
    tilt = (-0.1 + rng.normal(0, 0.05)) * pitch / row_pitch
    width = 0.38 + rng.normal(0, 0.035)
    floor = 0.09 * rng.uniform(0.8, 1.2)
    crotch = 0.03 + 0.09 * rng.beta(1, 3)
    index, x, y = canvas.window((x_0 - 0.15 * row_pitch, x_0 + 1.3 * row_pitch), (y_0 - 0.8 * pitch, y_0 + 0.8 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    half = width * np.clip(s, 0, 1) ** 0.7
    groove = (
        smooth_step(half - np.abs(t), 0.105)
        * smooth_step(s, 0.05)
        * (1 - smooth_step(s - 1.09 + 0.15 * np.abs(t), 0.13))
    )
    dip = np.exp(-(((s - 0.1) / 0.1) ** 2) - ((t / (0.085 + 0.03 * np.clip(s / 0.2, 0, 1))) ** 2))
    canvas.heights[index] -= floor * groove + crotch * dip


def _elaphe_tip(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """Draw the round edge where a finger ends on the next row, which lies lower there and rises again."""
    row_pitch, pitch = canvas.pitch
    x_tip = x_0 + row_pitch * (0.93 + rng.normal(0, 0.05))
    y_tip = y_0 - 0.1 * pitch
    drop = 0.028 * rng.uniform(0.4, 1.6)
    index, x, y = canvas.window((x_tip - 0.3 * row_pitch, x_tip + 0.8 * row_pitch), (y_tip - pitch, y_tip + pitch))
    t = (y - y_tip) / pitch
    s = (x - x_tip) / row_pitch + 0.5 * t**2
    canvas.heights[index] -= drop * smooth_step(s, 0.02) * np.exp(-np.maximum(s, 0) / 0.12) * np.exp(-((t / 0.42) ** 4))


def _elaphe_granules(canvas: Canvas, granules: Real, rng: np.random.Generator, x_0: float, y_0: float) -> None:
    """Draw a few large granules and some small ones along the ridge of a finger; overlaps keep the higher one."""
    row_pitch, pitch = canvas.pitch
    for number, radius, height in ((rng.poisson(2.6), 0.12, 0.09), (rng.poisson(5.0), 0.055, 0.03)):
        for _ in range(number):
            size = rng.uniform(0.7, 1.35)
            along = rng.uniform(0.0, 0.9)
            x_g = x_0 + along * row_pitch
            y_g = y_0 - 0.1 * along * pitch + rng.normal(0, 0.08) * pitch
            r = radius * size
            index, x, y = canvas.window((x_g - 3.5 * r, x_g + 4.5 * r), (y_g - 3 * r, y_g + 3 * r))
            # Granules lean along the finger, as the scan shows them.
            stretch = np.where(x > x_g, 1.4, 1.0)
            granule = height * size * np.exp(-(((x - x_g) / (stretch * r)) ** 2) - ((y - y_g) / r) ** 2)
            granules[index] = np.maximum(granules[index], granule)


def xenopeltis_synthetic(
    size: float | tuple[float, float] = 32.0,
    *,
    pixel_size: float = 0.0625,
    depth: float = 0.443,
    period: float = 1.552,
    seed: int = 0,
) -> HeightField:
    """Draw a synthetic replica of the shed skin of *Xenopeltis unicolor*, not a measurement.

    Rows of short round fingers, which point along +x and rise towards their tips like roof tiles. Rows run along y, one
    period apart along **x**, the diffracting direction. They meander by 10 to 20 degrees and occasionally fork or end.
    Fingers are 0.36 periods apart along y, with small deep pits between them; some are joined. The shape is modelled on
    a 5.9 µm AFM scan of the LANE lab, Geneva.

    `period` is the mean distance from row to row. size_x is rounded to whole periods, and the pitch of the fingers is
    adjusted to size_y; the patch holds at least two rows and four fingers.
    """
    check_profile(period, depth)
    rng = generator(seed)
    canvas = Canvas(size, pixel_size, pitch=(period, 0.36 * period), axis=0)
    row_pitch, pitch = canvas.pitch

    meander = 0.11 * row_pitch * canvas.noise(rng, 6.0, 1.3)
    faults = _faults(canvas, rng)
    rows = [(x, None) for x in canvas.centres(0)] + [(fault.x, fault) for fault in faults if fault.extra]
    fingers = []
    for x, own in rows:
        # Every row has a phase of its own, and a finger more or less than its neighbours where there are many.
        count = canvas.count[1] + round(rng.normal(0, 0.012 * canvas.count[1]))
        row_phase = rng.uniform()
        for index in range(count):
            y = (index + row_phase + rng.normal(0, 0.09)) * canvas.size[1] / count
            if not _present(faults, own, x, y, canvas):
                continue
            x_0 = x + _fault_shift(faults, x, y, canvas)
            x_0 += canvas.value_at(meander, x_0, y)
            fingers.append((x_0, y, row_pitch * (1 + rng.normal(0, 0.05))))
    for x_0, y_0, length in fingers:
        _xenopeltis_finger(canvas, rng, x_0, y_0, length)
    for x_0, y_0, length in fingers:
        _xenopeltis_pit(canvas, rng, x_0, y_0 + pitch / 2, length)
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
        """Return 1 inside the fault, 0 outside, smooth at its ends."""
        d = _wrapped(y - self.y, size_y)
        return float((erf((d + self.half) / 1.2) - erf((d - self.half) / 1.2)) / 2)


def _wrapped(distance: float, size: float) -> float:
    """Return the shortest distance on a circle of circumference `size`."""
    return (distance + size / 2) % size - size / 2


def _faults(canvas: Canvas, rng: np.random.Generator) -> list[_Fault]:
    """Draw separate faults, about one per 200 µm²; equally many add and remove a row, which keeps the mean pitch."""
    row_pitch = canvas.pitch[0]
    faults: list[_Fault] = []
    wanted = 2 * round(canvas.size[0] * canvas.size[1] / 400)
    for _ in range(20 * wanted):
        if len(faults) == wanted:
            break
        extra = len(faults) % 2 == 0
        # An added row lies between two rows, a missing row at the position of one.
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
    """Return whether the row at x has a finger at y; `own` is the fault that made the row, if one did."""
    if own is not None:
        return own.weight(y, canvas.size[1]) > 0.5
    return all(
        fault.extra
        or abs(_wrapped(x - fault.x, canvas.size[0])) > canvas.pitch[0] / 4
        or fault.weight(y, canvas.size[1]) < 0.5
        for fault in faults
    )


def _fault_shift(faults: list[_Fault], x: float, y: float, canvas: Canvas) -> float:
    """Return the shift of the row at x by the faults, µm: away from an added row, towards a missing one."""
    row_pitch = canvas.pitch[0]
    shift = 0.0
    for fault in faults:
        d = _wrapped(x - fault.x, canvas.size[0])
        nearest, sign = (row_pitch / 2, 1.0) if fault.extra else (row_pitch, -1.0)
        decay = np.exp(-max(abs(d) - nearest, 0.0) / (3 * row_pitch))
        shift += sign * np.sign(d) * row_pitch / 2 * decay * fault.weight(y, canvas.size[1])
    return float(shift)


def _xenopeltis_finger(canvas: Canvas, rng: np.random.Generator, x_0: float, y_0: float, length: float) -> None:
    """Draw a finger that rises from its root at x_0 to a round tip; where shapes overlap, the higher one stays."""
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
    """Draw the pit between two fingers, deepest near their roots."""
    pitch = canvas.pitch[1]
    depth = rng.uniform(0.01, 0.03) if rng.uniform() < 0.1 else rng.uniform(0.04, 0.11)
    start = 0.1 + rng.normal(0, 0.04)
    span = rng.uniform(0.55, 0.8)
    width = 0.17 * rng.uniform(0.7, 1.3)
    tilt = rng.normal(0.03, 0.06) * pitch / length
    index, x, y = canvas.window((x_0, x_0 + 1.1 * length), (y_0 - 0.9 * pitch, y_0 + 0.9 * pitch))
    s = (x - x_0) / length
    t = (y - y_0 - tilt * (x - x_0)) / pitch
    u = np.clip((s - start) / span, 0, 1)
    half = width * 2 * np.sqrt(u * (1 - u))  # an ellipse
    pit = smooth_step(half - np.abs(t), 0.12) * smooth_step(s - start - 0.03, 0.04) * (1 - u) ** 0.7
    canvas.heights[index] -= depth * pit
