"""What a shader for another renderer draws from: bins of wavelengths, orders or a continuum, powers over κ, indices.

Such a shader does not see the lights, but it may draw a wavelength and an order and return a lobe about the half vector
of the direction from which that light would come.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..array_types import Complex, Real
from ..errors import RequestError
from ..inspection.efficiency import description
from ..optics.color import SRGB_TO_XYZ, XYZ_to_linear_sRGB, daylight, matching_functions
from ..optics.geometry import diffracted, fresnel
from ..optics.media import Media, MediumBelow
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.recipe import Recipe
from ..settings import VISIBLE, wavelengths_inside
from ..spectrum.grids import OrderGrid

SHORTEST_DRAWN, LONGEST_DRAWN = 390.0, 720.0  # nm, outside of which a display needs next to nothing
_BINS = 48  # of wavelengths
_MAX_ORDERS = 1000  # among which the shader chooses by their powers
_ROWS, _COLUMNS = 32, 96  # of the cells of a continuum
_MAX_DENSITY = 0.15  # of the cells, at one frequency; else order 0 of a disc takes most of them, and few remain between
_SLICES = (17, 33, 65, 129)  # of κ
_MAX_SLICE_ERROR = 2e-3  # of the reflected power, of orders; of a continuum, which has more values, ten times as much
_COSINES, _AZIMUTHS, _LIGHTS = 12, 13, 5  # of the table of albedos of a continuum
_MAX_HEIGHT_SCALE = 2.0  # of a grating
_MAX_SCALE_OF_PATCHES = 1.5  # which take longer; enough for the coat of a disc, which scales κ by its index


def shader_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe of the spectrum of a shader: of a grating or of patches, one that allows for larger heights."""
    settings = recipe.settings
    if settings.extent != "tile" or settings.wavelengths != VISIBLE:
        return recipe
    scale = _MAX_HEIGHT_SCALE if recipe.patches == 1 else _MAX_SCALE_OF_PATCHES
    return replace(recipe, settings=replace(settings, wavelengths=wavelengths_inside(1.0, scale)))


@dataclass(frozen=True, eq=False)
class ShaderTables:
    """The arrays of a shader; lengths in µm, frequencies in cycles/µm.

    Attributes:
        what: the surface and the medium below it, in one line.
        edges: of the bins of wavelengths, of equal probability, (n + 1,).
        colours: linear sRGB of the light of each bin, (n, 3); their mean is white, (1, 1, 1).
        index: of the medium below, in the middle of each bin, (n,); 0 is the perfect mirror.
        max_kappa: of the last of the equally spaced κ.
        lobe_width: standard deviation of an order.
        powers: (orders or cells, κ); of cells, multiplied by their number.
        frequencies: of the orders, (orders, 2); of a continuum, none.
        rows: edges of the rows of cells of about equal mean power, (r + 1,); of orders, none.
        columns: edges of the columns in each row, (r, c + 1); of orders, none.
        albedo: what a perfect mirror would reflect, by wavelength, azimuth of ω_o and cos θ_o; of orders, none.
        sheet: whether the orders are those of a film that transmits light, with a flat lower face.

    Raises:
        ValueError: if it has both orders and cells, or shapes differ.
    """

    what: str
    edges: Real
    colours: Real
    index: Complex
    max_kappa: float
    lobe_width: float
    powers: Real
    frequencies: Real | None = None
    rows: Real | None = None
    columns: Real | None = None
    albedo: Real | None = None
    sheet: bool = False

    def __post_init__(self) -> None:
        bins = len(self.edges) - 1
        if self.colours.shape != (bins, 3) or self.index.shape != (bins,):
            shapes = f"{self.colours.shape} and {self.index.shape}"
            raise RequestError(f"colours and index: got the shapes {shapes}, wanted ({bins}, 3) and ({bins},)")
        if self.frequencies is not None:
            sizes = (len(self.frequencies),)
        elif self.rows is not None and self.columns is not None and self.albedo is not None:
            sizes = ((len(self.rows) - 1) * (self.columns.shape[1] - 1),)
        else:
            raise RequestError("frequencies: got none, wanted those of orders, or rows, columns and albedo")
        if self.powers.shape[:1] != sizes:
            raise RequestError(f"powers: got the shape {self.powers.shape}, wanted {sizes[0]} rows")

    @classmethod
    def of_spectrum(cls, spectrum: GratingSpectrum, below: MediumBelow, sheet: bool = False) -> ShaderTables:
        """Return the tables of a spectrum of scalar theory and of the medium below it, in air, or of a sheet of it.

        Of a continuum, they show reflected light alone.

        Raises:
            ValueError: if the material is wrong.
        """
        what = " ".join(description(spectrum.source, Media(below), 0.0).split())
        edges, colours = bins_of_wavelengths()
        index = np.array([below.index_at(w) for w in (edges[1:] + edges[:-1]) / 2], np.complex128)
        index = np.where(np.isinf(index), 0, index)
        max_kappa = min(_MAX_HEIGHT_SCALE * 4e3 * np.pi / SHORTEST_DRAWN, spectrum.max_kappa)
        q = np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1)
        kept = np.hypot(*np.moveaxis(q, -1, 0)) <= 2e3 / SHORTEST_DRAWN
        common = (what, edges, colours, index, max_kappa, spectrum.lobe_width)
        if isinstance(spectrum.grid, OrderGrid) and kept.sum() <= _MAX_ORDERS:
            powers = _sliced(spectrum, max_kappa, lambda values: values[kept], _MAX_SLICE_ERROR)
            return cls(*common, powers, frequencies=q[kept], sheet=sheet)
        rows, columns, of_cells = _cells(spectrum, max_kappa)
        powers = _sliced(spectrum, max_kappa, of_cells, 10 * _MAX_SLICE_ERROR)
        albedo = _albedo(rows, columns, powers, max_kappa, edges)
        return cls(*common, powers, rows=rows, columns=columns, albedo=albedo)

    @property
    def held(self) -> str:
        """What they hold, in a few words."""
        if self.columns is None:
            what = f"{len(self.powers)} orders"
        else:
            what = f"{self.columns.shape[1] - 1} × {len(self.columns)} frequencies"
        return f"{what}, {self.powers.shape[-1]} values of κ"

    @property
    def max_height_scale(self) -> float:
        """The largest factor of the heights for which all wavelengths have powers."""
        return self.max_kappa / (4e3 * np.pi / SHORTEST_DRAWN)

    @property
    def entering(self) -> float:
        """The fraction of diffuse light that enters a dielectric."""
        index = float(np.median(self.index.real))
        if index <= 0:
            return 0.0
        cosines = (np.arange(200) + 0.5) / 200
        return 1 - float(np.mean(2 * cosines * np.mean(fresnel(cosines, index), axis=0)))


def bins_of_wavelengths() -> tuple[Real, Real]:
    """Return the edges of bins of equal probability, µm, (n + 1,), and the linear sRGB of their light, (n, 3).

    The probability is that of what a display needs, the mean of |r|, |g| and |b|; half of it is the luminance. The mean
    of the colours is white, (1, 1, 1).
    """
    wavelengths = np.arange(SHORTEST_DRAWN, LONGEST_DRAWN + 0.01, 0.1)
    colours = XYZ_to_linear_sRGB(matching_functions(wavelengths)) * daylight(wavelengths)[:, None]
    colours /= colours.sum(axis=0)
    need = np.abs(colours).mean(axis=1)
    density = need / need.sum() + np.maximum(colours @ SRGB_TO_XYZ[1], 0)
    chance = np.concatenate([[0.0], np.cumsum(density / density.sum())])
    bounds = np.append(wavelengths, LONGEST_DRAWN + 0.1) - 0.05
    edges = np.interp(np.linspace(0, 1, _BINS + 1), chance, bounds)
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(colours, axis=0)])
    at_edges = np.stack([np.interp(edges, bounds, column) for column in summed.T], axis=1)
    return edges * 1e-3, _BINS * np.diff(at_edges, axis=0)


def _sliced(spectrum: GratingSpectrum, max_kappa: float, of_nodes: Callable[[Real], Real], error: float) -> Real:
    """Return powers at equally spaced κ from 0 to `max_kappa`, (n, K), which are linear between them up to `error`."""

    def slices(count: int) -> Real:
        return np.stack(
            [of_nodes(np.maximum(spectrum.powers(k), 0)) for k in np.linspace(0, max_kappa, count)], axis=-1
        )

    for count in _SLICES:
        fine = slices(2 * count - 1)
        between = (fine[:, :-1:2] + fine[:, 2::2]) / 2
        if np.abs(between - fine[:, 1::2]).sum(axis=0).max() < error * fine.sum(axis=0).max():
            break
    return fine[:, ::2]


def _cells(spectrum: GratingSpectrum, max_kappa: float) -> tuple[Real, Real, Callable[[Real], Real]]:
    """Return edges of rows and columns of cells of equal limited mean power, and their powers from those of nodes.

    The edges of the rows are (n + 1,), those of the columns in each (n, k + 1), in cycles/µm. Powers are multiplied by
    the number of cells: they are then the weights of a sample that draws all cells with equal probability.
    """
    kappas = np.linspace(0.3, 1, 8) * min(max_kappa, 4e3 * np.pi / SHORTEST_DRAWN)
    mean = np.mean([np.maximum(spectrum.powers(kappa), 0) for kappa in kappas], axis=0)
    mean = np.minimum(mean, _MAX_DENSITY * mean.sum())
    q_x, q_y = spectrum.grid.frequencies()
    rows, of_rows = _equal_parts(q_y, mean.sum(axis=1), _ROWS)
    pairs = [_equal_parts(q_x, weights @ mean, _COLUMNS) for weights in of_rows]

    def of_cells(powers: Real) -> Real:
        strips = of_rows @ powers
        return (
            _ROWS
            * _COLUMNS
            * np.concatenate([of_columns @ strip for (_, of_columns), strip in zip(pairs, strips, strict=True)])
        )

    return rows, np.stack([columns for columns, _ in pairs]), of_cells


def _equal_parts(nodes: Real, power: Real, count: int) -> tuple[Real, Real]:
    """Return edges of parts of equal power, (n + 1,), and the fraction of each node in each part, (n, nodes).

    The power of a node is spread evenly up to half way to its neighbours. The outermost edges leave out a tenth of
    their parts, without which the weak tails of a spectrum would be drawn too far out.
    """
    step = nodes[1] - nodes[0] if len(nodes) > 1 else 1e-3
    bounds = np.append(nodes, nodes[-1] + step) - step / 2
    chance = np.concatenate([[0.0], np.cumsum(power + 1e-9 * power.max())])
    edges = np.interp(np.linspace(0, chance[-1], count + 1), chance, bounds)
    inside = np.minimum(edges[1:, None], bounds[1:]) - np.maximum(edges[:-1, None], bounds[:-1])
    edges[[0, -1]] = np.interp(np.array([0.1, count - 0.1]) / count * chance[-1], chance, bounds)
    return edges, np.maximum(inside, 0) / step


def _albedo(rows: Real, columns: Real, powers: Real, max_kappa: float, edges: Real) -> Real:
    """Return what a perfect mirror would reflect, by wavelength, azimuth of ω_o and cos θ_o."""
    q = np.stack(
        [
            (columns[:, 1:] + columns[:, :-1]).ravel() / 2,
            np.repeat((rows[1:] + rows[:-1]) / 2, _COLUMNS),
        ],
        axis=-1,
    )
    albedo = np.zeros((_LIGHTS, _AZIMUTHS, _COSINES))
    for k, j, i in np.ndindex(albedo.shape):
        wavelength = float(np.interp(k / (_LIGHTS - 1), np.linspace(0, 1, len(edges)), edges))
        cosine, azimuth = max(i / (_COSINES - 1), 0.02), (j / (_AZIMUTHS - 1) - 0.5) * 2 * np.pi
        tangent = np.sqrt(1 - cosine**2) * np.array([np.cos(azimuth), np.sin(azimuth)])
        found = diffracted(tangent, wavelength * q)
        at = np.minimum(2 * np.pi * found.v_z / wavelength / max_kappa, 1) * (powers.shape[1] - 1)
        below = np.minimum(at.astype(int), powers.shape[1] - 2)
        kept = powers[found.kept]
        number = np.arange(len(kept))
        power = kept[number, below] * (1 - at + below) + kept[number, below + 1] * (at - below)
        albedo[k, j, i] = (power * found.k_g).sum() / len(q)
    return albedo
