"""The factor e(ω, λ) that bounds the albedo by one, as a table.

With R = 1 the BRDF K·G·S(q; κ)/λ² has an albedo a(ω_i, λ) (`albedo.py`) that exceeds one for some directions. The BSDF
multiplies by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e ≤ 1, about 1/a where a > 1

which is reciprocal, and one where neither direction reflects more than it receives. Where e ≤ 1/a, E ≤ e(ω_i) bounds
the albedo by one; where a varies too fast for the table, `furnace.py` lowers e until the albedo with E is bounded.

Directions are stored in angles about the pattern's y axis: with c = √(1 − ω_y²), the cosine of the latitude,

    x = ω_x/(c + ω_z) = tan(longitude/2),    y = ω_y/(1 + c) = tan(latitude/2),    both in [−1, 1]

Near the horizon, |x| = 1, albedos change fastest: the nodes are equidistant in s, 1 − |x| = t² with
1 − |s| = (t + t²)/2. The third coordinate is ν = 1/λ.
A grating of one row keeps ω_o,y = −ω_i,y. Then K and G depend on the longitudes alone, and λ enters everywhere as λ/c:
a is a function of x and ν = c/λ, and the table has one row in y.

Without shadowing a grows as 1/cos² θ towards the horizon, which no table follows: there e is the table's value times
min(1, cos θ/cos 85°)².
"""

from __future__ import annotations

import base64
import binascii
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from ..errors import RequestError

HORIZON = float(np.cos(np.deg2rad(85)))
"""cos θ below which e falls with cos² θ where there is no shadowing."""

SHADOWING = ("v_cavity", "none")


@dataclass(frozen=True, eq=False)
class EnergyTable:
    """e at nodes, linear between them in s, y and ν.

    Attributes:
        values: float32 (N_y, N_ν, N_s); y and s from −1 to 1, ν as in `frequencies`.
        frequencies: (smallest, largest) ν in 1/µm.
        conical: ν = c/λ and N_y = 1; else ν = 1/λ.
        shadowing: "v_cavity" or "none".
        excess: an upper 95 % confidence bound of A − 1, A being the albedo with E and with the rounding of `packed`
            (`furnace.py`): of the largest of 48 places, found among 1024 random directions (to 89.9°) and wavelengths,
            for deep surfaces in three sets of 4096, and by a search around the largest of them. None of these places
            made or lowered the table. For a tile, half of them lie where an order emerges.
        loss: (mean, largest) 1 − e over those of them with a ≤ 1: light that is lost to the table's resolution.
    """

    values: NDArray[np.float32] = field(repr=False)
    frequencies: tuple[float, float]
    conical: bool
    shadowing: str = "v_cavity"
    excess: float = 0.0
    loss: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        v = self.values
        if v.ndim != 3 or v.dtype != np.float32 or min(v.shape[1:]) < 2 or not ((v >= 0) & (v <= 1)).all():
            raise RequestError(f"energy table: got {v.dtype} {v.shape}, wanted float32 from 0 to 1 with three axes")
        if not 0 <= self.frequencies[0] < self.frequencies[1] < np.inf:
            raise RequestError(f"energy table: got frequencies {self.frequencies}, wanted two that increase")
        if self.shadowing not in SHADOWING:
            raise RequestError(f"shadowing: got {self.shadowing!r}, wanted one of {', '.join(SHADOWING)}")
        v.setflags(write=False)

    @property
    def needed(self) -> bool:
        """Some direction would reflect more than it receives."""
        return bool((self.values < 1).any())

    def packed(self) -> tuple[NDArray[np.uint8], float, float]:
        """Bytes b and numbers (least, step) with `values` ≥ least + step · b, as the renderer holds them."""
        least = float(self.values.min())
        step = (1 - least) / 255 or 1.0
        # A value that is a whole number of steps stays one, and one stays one.
        return np.floor((self.values - least) / step + 1e-3).astype(np.uint8), least, step

    def places(self, directions: NDArray[np.float64], wavelengths: ArrayLike) -> NDArray[np.float64]:
        """Where ω (n, 3) and λ (µm) lie: (row, slice, column), (n, 3), in cells."""
        c = np.sqrt(directions[:, 0] ** 2 + directions[:, 2] ** 2)
        x = directions[:, 0] / np.maximum(c + directions[:, 2], 1e-7)
        row = (directions[:, 1] / (1 + c) + 1) / 2 * (self.values.shape[0] - 1)
        first, last = self.frequencies
        nu = (c if self.conical else 1) / np.asarray(wavelengths)
        cell = np.clip((nu - first) / (last - first), 0, 1) * (self.values.shape[1] - 1)
        return np.stack([row, cell + 0 * row, (stretched(x) + 1) / 2 * (self.values.shape[2] - 1)], -1)

    def at(self, directions: NDArray[np.float64], wavelengths: ArrayLike) -> NDArray[np.float64]:
        """e(ω, λ) as the renderer has it, (n,), for ω (n, 3) along the pattern's axes and λ in µm."""
        steps, least, step = self.packed()
        e = between(least + step * steps.astype(np.float64), self.places(directions, wavelengths))
        return e * self.horizon(directions[:, 2]) if self.needed else e

    def horizon(self, cosines: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the table's value is multiplied by, for cos θ (n,)."""
        return np.minimum(1, cosines / HORIZON) ** 2 if self.shadowing == "none" else np.ones_like(cosines)

    def as_plain(self) -> dict[str, Any]:
        """As numbers and texts, for JSON."""
        packed = base64.b64encode(zlib.compress(self.values.astype("<f4").tobytes(), 9)).decode("ascii")
        return {**asdict(self), "values": packed, "shape": self.values.shape}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> EnergyTable:
        """The reverse of `as_plain`.

        Raises:
            ValueError, TypeError or KeyError: if it is not a table.
        """
        rest = {**plain, "frequencies": tuple(plain["frequencies"]), "loss": tuple(plain["loss"])}
        shape, size = rest.pop("shape"), 4 * int(np.prod(plain["shape"], dtype=np.int64))
        try:
            # No more than there should be: a damaged file may hold a long row of zeros.
            content = zlib.decompressobj().decompress(base64.b64decode(plain["values"]), size + 1)
        except (zlib.error, binascii.Error) as error:
            raise RequestError(f"energy table: {error}") from None
        if not 0 < size < 1 << 26 or len(content) != size:
            raise RequestError(f"energy table: got {len(content)} bytes, wanted {size}")
        rest["values"] = np.frombuffer(content, "<f4").astype(np.float32).reshape(shape)
        return cls(**rest)


def between(values: NDArray, places: NDArray[np.float64]) -> NDArray:
    """The table at places (row, slice, column), (n, 3), linear between nodes; beyond, the nearest."""
    return ndimage.map_coordinates(values, places.T, order=1, mode="nearest")


def stretched(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """s of x."""
    rest = np.maximum(1 - np.abs(x), 0)
    return np.copysign(1 - 0.5 * (np.sqrt(rest) + rest), x)


def directions_at(s: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vectors (..., 3) of the coordinates s and y, which broadcast."""
    s, y = np.broadcast_arrays(np.asarray(s, np.float64), np.asarray(y, np.float64))
    t = np.sqrt(0.25 + 2 * np.maximum(1 - np.abs(s), 0)) - 0.5
    rest = t**2  # 1 − |x|
    x = np.copysign(1 - rest, s)
    c = (1 - y**2) / (1 + y**2)
    # 1 − x² without cancellation.
    return np.stack([c * 2 * x / (1 + x**2), 2 * y / (1 + y**2), c * rest * (2 - rest) / (1 + x**2)], -1)
