"""`design`: the request and its checks, and the search for the relief."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
import scipy.fft
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray

from ..array_types import Real
from ..errors import RequestError, check_whole
from ..machine import available_memory
from ..progress import Progress, bytes_text, silent
from ..rigorous.solver import one_thread
from ..settings import MIN_WAVELENGTH
from .colour_distance import ColourDistance
from .far_field import FarField, lobes_in_bins, nearest_levels
from .plate import Plate
from .result import Design, memory_of_prediction
from .target import is_coloured, wanted_fractions, with_unused

WHITE = 1e3 / np.linspace(1e3 / 430, 1e3 / 670, 8)  # nm, equidistant in 1/λ
_COARSE, _FINE = 3, 6  # pixels along a texel: of the first searches, and of the last
FIRST_ITERATIONS, LAST_ITERATIONS = 75, 400
_FIXED_FRACTIONS = (0.4, 0.7, 0.9, 1.0)  # of the texels, that are set to levels one round after the other
_LOSSES_PER_ITERATION = 1.1
_TIMED_LOSSES = 2  # for the estimate of the time
_MAX_MEMORY = 16e9  # bytes, where the system does not say how many are available
_CORRECTIONS, _TOLERANCE = 20, 1e-8  # of L-BFGS-B: stored steps, and the decrease of L at which it ends


@one_thread()
def design(
    target: ArrayLike,
    texel: float = 0.8,
    texels: int = 32,
    height_range: float = 0.8,
    angle: float = 17.5,
    wavelengths: float | Sequence[float] | None = None,
    int_ior: float | str | None = None,
    levels: int | None = None,
    *,
    seen_on: str = "wall",
    unused: str = "outside",
    tool_blur: float = 0.13,
    starts: int = 24,
    seed: int = 0,
    progress: Progress = silent,
    expect: Callable[[float, float], None] = lambda seconds, memory: None,
) -> Design:
    """Compute a relief that casts a picture, for light along its normal.

    The relief is periodic, a square of `texels` × `texels` of constant height, blurred by the tool. Its heights
    minimise the squared difference between the light in each direction and the wanted fraction, averaged over the
    wavelengths with more weight on the larger (`FarField`), and of a coloured picture that of the colours seen, hue
    before lightness (`ColourDistance`), by L-BFGS-B (Byrd et al. 1995) from the best of several
    random reliefs. The coherence length is half the period, so that the orders merge into a picture.

    Args:
        target: the wanted radiance, (rows, columns), or (rows, columns, 3) for linear sRGB; ≥ 0, rows from the top, as
            it is to be seen. Pixels are squares; the middles of the edges of the frame are at direction cosines of
            ±sin(angle), and its top is +y of ω_o.
        texel: side of a texel, µm.
        texels: along the period.
        height_range: largest difference of heights, µm.
        angle: from the mirror direction to the middle of an edge of the picture, degrees.
        wavelengths: nm, one number for a laser; by default white light, 430–670 nm.
        int_ior: index of a sheet that transmits the light, which falls on its relief: a number, the name of a medium
            with dispersion, or a file (`refractive_indices.index_of`); by default the relief reflects.
        levels: number of equidistant heights; by default they are continuous.
        seen_on: "wall": seen from the side of the plate; "screen": a translucent one, seen from the other side.
        unused: where light goes that the colours of the target cannot use: "outside" of the frame, or in "mirror"
            direction, order 0.
        tool_blur: standard deviation of the Gaussian by which the tool blurs heights, µm; 0 for none.
        starts: random reliefs from which the search begins; the best of them is continued.
        seed: of the random reliefs.
        progress: called with (iterations done, iterations in all).
        expect: called once, before the search, with the seconds that it will take on this machine, and the bytes of
            memory, about.

    Returns:
        The relief and its predicted far field. After a KeyboardInterrupt it is the best so far (`Design.interrupted`).

    Raises:
        ValueError: if an argument is out of range, or no relief of these texels can cast the target.
    """
    plate = Plate(
        texel=texel,
        texels=texels,
        height_range=height_range,
        angle=angle,
        wavelengths=_wavelengths(wavelengths),
        int_ior=int_ior,
        levels=levels,
        tool_blur=tool_blur,
        seen_on=seen_on,
        unused=unused,
    )
    check_whole("starts", starts, 1)
    check_whole("seed", seed, 0)
    wanted = wanted_fractions(target, plate)
    _check_memory(plate)
    search = _Search(plate, with_unused(wanted, plate), starts, progress, expect)
    interrupted = False
    try:
        search(seed)
    except KeyboardInterrupt:
        interrupted = True
    heights = search.heights
    if plate.levels is not None:  # interrupted, some may not be set yet
        heights = nearest_levels(heights, plate.height_range, plate.levels)
    if plate.mirrored:  # m_x of each order changes its sign
        heights, wanted = heights[:, ::-1], wanted[..., ::-1]
    return Design.of(heights, plate, wanted, interrupted)


def _check_memory(plate: Plate) -> None:
    """Refuse a plate so large, as with a tiny angle, that its prediction does not fit into the memory."""
    needed, available = memory_of_prediction(plate), available_memory() or _MAX_MEMORY
    if needed > available:
        largest = plate.period * math.sqrt(available / needed)
        raise RequestError(
            f"texel: got {plate.texels} of {plate.texel:g} µm, a period of {plate.period:.4g} µm, whose prediction "
            f"takes {bytes_text(needed)} of memory, wanted at most the {bytes_text(available)} that are available: "
            f"{largest:.3g} µm, with a larger angle"
        )


def _wavelengths(given: float | Sequence[float] | None) -> Real:
    """Return the wavelengths in nm as an array."""
    try:
        found = WHITE if given is None else np.atleast_1d(np.asarray(given, np.float64))
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.ndim != 1 or not found.size or not ((found >= MIN_WAVELENGTH) & (found < np.inf)).all():
        raise RequestError(f"wavelengths: got {given!r}, wanted one or several in nm, from {MIN_WAVELENGTH:g} nm on")
    return found


def far_field_of(
    plate: Plate, wanted: Real, coherence_length: float, per_texel: int, dtype: type = np.float32
) -> FarField:
    """Return the map from heights to light in the bins of `wanted`, (w, bins, bins), at a coherence length in µm.

    `per_texel` is the number of pixels along a texel. Single precision takes less than half the time; its gradient is
    accurate to 1e-6 of the maximum.
    """
    pixels, edges = plate.texels * per_texel, plate.edges(wanted.shape[1])
    orders = scipy.fft.fftfreq(pixels, 1 / pixels)
    lobes = [lobes_in_bins(edges, orders, plate.period, w * 1e-3, coherence_length) for w in plate.wavelengths]
    # Light that colours cannot use has their complement, in the mirror direction.
    keeps_colours = plate.unused == "outside" and np.ptp(plate.wavelengths) >= 2 and is_coloured(wanted)
    colours = ColourDistance.of(wanted, plate.wavelengths) if keeps_colours else None
    return FarField(plate.spread(per_texel), plate.kappa, np.array(lobes, dtype), wanted.astype(dtype), colours)


def _seconds(far_field: FarField, heights: Real) -> float:
    """Return how long one evaluation of the loss takes; the first one, which allocates memory, takes longer."""
    far_field.loss(heights)
    begin = time.perf_counter()
    for _ in range(_TIMED_LOSSES):
        far_field.loss(heights)
    return (time.perf_counter() - begin) / _TIMED_LOSSES


class _Search:
    """The search for the heights of the texels; an exception, such as KeyboardInterrupt, loses nothing."""

    def __init__(
        self, plate: Plate, wanted: Real, starts: int, progress: Progress, expect: Callable[[float, float], None]
    ) -> None:
        self._expect = expect
        self._plate, self._wanted, self._starts = plate, wanted, starts
        self._progress, self._done, self._total = progress, 0, starts * 2 * FIRST_ITERATIONS + LAST_ITERATIONS
        # Loss and heights of the best relief of each start.
        self._found: list[tuple[float, Real]] = []

    @property
    def heights(self) -> Real:
        """The heights with the smallest loss so far, (texels, texels) µm."""
        flat = np.zeros(2 * (self._plate.texels,))
        return min(self._found, key=lambda pair: pair[0], default=(0.0, flat))[1]

    def __call__(self, seed: int) -> None:
        """Search from random reliefs, first with lobes of twice the width, then from the best of them to the end."""
        wide, own, fine = (
            far_field_of(self._plate, self._wanted, scale * self._plate.coherence_length, per_texel)
            for scale, per_texel in ((0.5, _COARSE), (1.0, _COARSE), (1.0, _FINE))
        )
        coarse, exact = (_seconds(far_field, self.heights) for far_field in (own, fine))
        losses = self._starts * 2 * FIRST_ITERATIONS * coarse + LAST_ITERATIONS * exact
        self._expect(_LOSSES_PER_ITERATION * losses, memory_of_prediction(self._plate))
        random = np.random.default_rng(seed)
        for _ in range(self._starts):
            heights = self._minimised(wide, self._random_relief(random), FIRST_ITERATIONS)
            self._minimised(own, heights, FIRST_ITERATIONS)
        heights = self.heights
        self._found = [(math.inf, heights)]  # losses of another number of pixels cannot be compared
        if self._plate.levels is None:
            self._minimised(fine, heights, LAST_ITERATIONS)
            return
        fixed = np.zeros(heights.shape, bool)
        for fraction in _FIXED_FRACTIONS:
            heights = self._minimised(fine, heights, LAST_ITERATIONS // len(_FIXED_FRACTIONS), fixed)
            nearest = nearest_levels(heights, self._plate.height_range, self._plate.levels)
            distance = np.abs(nearest - heights)
            fixed = distance <= np.quantile(distance, fraction)
            heights = np.where(fixed, nearest, heights)
            self._found = [(fine.loss(heights)[0], heights)]

    def _random_relief(self, random: np.random.Generator) -> Real:
        """Return smooth random heights, steep enough for light to reach the edges of the picture."""
        plate = self._plate
        # A facet of slope s directs light to the direction cosine s times the phase per height, κλ/2π.
        phase = float(np.abs(plate.kappa * plate.wavelengths).mean()) * 1e-3 / (2 * np.pi)
        length = plate.height_range * phase / (2 * np.sin(np.deg2rad(plate.angle)))
        noise = random.standard_normal(2 * (plate.texels,))
        smooth = scipy.ndimage.gaussian_filter(noise, min(length / plate.texel, plate.texels / 6), mode="wrap")
        return plate.height_range * (smooth - smooth.min()) / max(np.ptp(smooth), 1e-30)

    def _minimised(
        self, far_field: FarField, heights: Real, iterations: int, fixed: NDArray[np.bool_] | bool = False
    ) -> Real:
        """Return the heights of the smallest loss that L-BFGS-B finds from `heights`, some of them `fixed`."""
        from scipy.optimize import Bounds, minimize

        self._found.append((math.inf, heights))

        def loss(flat: Real) -> tuple[float, Real]:
            value, gradient = far_field.loss(flat.reshape(heights.shape))
            if value < self._found[-1][0]:
                self._found[-1] = value, flat.reshape(heights.shape).copy()
            return value, gradient.ravel()

        begin = self._done

        def report(_: object) -> None:
            self._done += 1
            self._progress(self._done, self._total)

        minimize(
            loss,
            heights.ravel(),
            jac=True,
            method="L-BFGS-B",
            bounds=Bounds(
                np.where(fixed, heights, 0).ravel(), np.where(fixed, heights, self._plate.height_range).ravel()
            ),
            callback=report,
            options={"maxiter": iterations, "maxcor": _CORRECTIONS, "ftol": _TOLERANCE, "gtol": 0.0},
        )
        self._done = begin + iterations
        return self._found[-1][1]
