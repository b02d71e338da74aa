"""Base classes of the variants of the shader, and the gain (eq. 3.10)."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..bsdf.device_tables import larger, opaque
from ..optics.geometry import k_g
from ..settings import SUN_COHERENCE_LENGTH, lobe_width
from ..surface.heightfield import HeightField
from .quirks import Quirks
from .taper import tapered
from .taylor_textures import MAX_TEXTURE_KAPPA, TaylorTextures, taylor_transforms, terms_for
from .tristimulus import (
    FIRST_WAVELENGTH,
    PUBLISHED_R0,
    WAVELENGTH_COUNT,
    WAVELENGTH_STEP,
    SpectralWeights,
    rgb_matrix,
)

if TYPE_CHECKING:
    from typing_extensions import Self

SERIES_ERROR = 1e-4  # of the amplitudes, if the number of Taylor terms is not given


class Gain:
    """C(ω_i, ω_o) without F and with shadowing: the factors independent of wavelength.

    Relative to a flat mirror at normal incidence,

        C = F(ω_i·h)/F(1) · (1 + ω_i·ω_o)²/((cos θ_i + cos θ_o)² cos θ_o),

    which is K cos θ_i of the BRDF (`optics/geometry.py`), and G = min(1, 2(n·h)(n·ω_o)/(ω_o·h), 2(n·h)(n·ω_i)/(ω_o·h))
    (Torrance and Sparrow 1967).

    Attributes:
        cos_half: ω_o·h.
        falloff: (1 − ω_o·h)⁵ of Schlick's approximation (1994; eq. B.1), F = R₀ + (1 − R₀)(1 − ω_o·h)⁵.
        factor: K G cos θ_i; zero below the horizon.
        active: both directions are in the upper hemisphere.
    """

    def __init__(self, wi: mi.Vector3f, wo: mi.Vector3f, shadowing: bool, active: mi.Bool) -> None:
        self.active = active & (wi.z > 0) & (wo.z > 0)
        cos_i, cos_o = larger(wi.z, 1e-7), larger(wo.z, 1e-7)
        self.u, self.v, self.w = -wi - wo
        square = dr.square(self.u) + dr.square(self.v)
        self.cos_half = 0.5 * dr.sqrt(square + dr.square(self.w))
        x = 1 - self.cos_half
        self.falloff = dr.square(dr.square(x)) * x
        self.factor = dr.select(
            self.active, k_g(cos_i, cos_o, square, shadowing=shadowing, select=dr.select) * cos_i, 0
        )


class Shader:
    """Base class of the shaders of a tile.

    Directions are unit vectors in the frame of the tile, z being the normal, and point away from the surface: ω_i to
    the light, ω_o to the viewer. An instance is bound to the Mitsuba variant in which it was made.

    Attributes:
        own_quirks: names of the quirks that affect this shader.
        brightness_unit: factor of the colour for a brightness of one.
    """

    own_quirks: ClassVar[tuple[str, ...]]
    brightness_unit: ClassVar[float] = 1.0

    def __init__(self, height_field: HeightField, quirks: Quirks, shadowing: bool = True) -> None:
        self.tile_size = height_field.tile_size
        self.quirks = quirks
        self.shadowing = shadowing

    @property
    def peak(self) -> float:
        """S(0) of a flat surface, µm², the normalisation of the relative radiance."""
        raise NotImplementedError

    @property
    def texel_reads(self) -> int:
        """The maximum number of texels read for one shading point."""
        raise NotImplementedError

    def with_quirks(self, quirks: Quirks) -> Self:
        """Return the same shader with other quirks; tables are shared."""
        other = copy.copy(self)
        other.quirks = quirks
        return other

    @property
    def has_free_scale(self) -> bool:
        """Whether the brightness scales the colour, which is not a radiance in the scene's units."""
        return True

    def weights(self, r_0: ArrayLike = PUBLISHED_R0, light: ArrayLike | None = None) -> SpectralWeights:
        """Return the `SpectralWeights` of a material and a light."""
        return SpectralWeights(self.quirks, self.peak, r_0, light)

    def rgb(
        self,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        weights: SpectralWeights,
        active: mi.Bool = True,
        height_scale: mi.Float = 1.0,
    ) -> mi.Color3f:
        """Return linear RGB, before gamma.

        Args:
            wi: ω_i.
            wo: ω_o.
            weights: from `weights`.
            active: mask.
            height_scale: scales the heights.
        """
        raise NotImplementedError


class TextureShader(Shader):
    """Shader that sums Taylor textures, wavelength by wavelength, into XYZ.

    The relative radiance of algorithm 4.3 is

        ρ(λ) = F/F₀ · K G cos θ_i · |P(q; κ)|²,     q = (u, v)/λ,     κ = −2πw/λ,

    with |P|² = 1 for a flat mirror, and the colour is ∫ ρ(λ) S(λ) (x̄, ȳ, z̄) dλ.

    Attributes:
        origin_at_centre: whether x = 0 is the centre of the tile (`taylor_transforms`).
        published_terms: number of Taylor terms of the published shader.
    """

    own_quirks: ClassVar[tuple[str, ...]] = (
        *("schlick", "fixed_index", "floor_anchor", "fixed_terms", "fixed_coherence"),
        *("d65_light", "relative", "cie_rgb_matrix"),
    )
    origin_at_centre: ClassVar[bool] = False
    published_terms: ClassVar[int]

    def __init__(
        self,
        height_field: HeightField,
        quirks: Quirks,
        *,
        coherence_length: float = SUN_COHERENCE_LENGTH,
        corrected_coherence_length: float | None = None,
        extent: str = "tile",
        terms: int | None = None,
        max_height_scale: float = 1.0,
        exact_fresnel: bool = False,
        shadowing: bool = True,
    ) -> None:
        """Compute the textures.

        Args:
            height_field: the tile.
            quirks: the quirks of the published shader to keep.
            coherence_length: L_c in µm.
            corrected_coherence_length: instead, without the quirk `fixed_coherence`.
            extent: "tile", or "sample" for a piece of an irregular surface.
            terms: number of Taylor terms; default: as published, or as many as an error of 1e-4 requires.
            max_height_scale: of `rgb`, for the number of terms.
            exact_fresnel: the material is a dielectric whose reflectance is exact without the quirk `schlick`.
            shadowing: include G.

        Raises:
            ValueError: if an argument is invalid.
        """
        super().__init__(height_field, quirks, shadowing)
        lobe_width(coherence_length)  # raises unless it is a valid length
        self._coherence_lengths = coherence_length, corrected_coherence_length or coherence_length
        self.extent, self.exact_fresnel = extent, exact_fresnel
        self._height_field, self._terms, self._max_height_scale = height_field, terms, max_height_scale
        self._textures: dict[tuple[int, tuple[float, float] | None], TaylorTextures] = {}
        self._bind()

    def with_quirks(self, quirks: Quirks) -> Self:
        other = super().with_quirks(quirks)
        other._bind()
        return other

    def _bind(self) -> None:
        """Set up everything that depends on the quirks."""
        taper, lengths = None, (self.coherence_length, self.coherence_length)
        if self.tapers:
            taper, lengths = tapered(self._height_field, self.coherence_length)
        self.sigmas = tuple(self.sigma * self.coherence_length / length for length in lengths)
        kind = self.terms, lengths if self.tapers else None
        if kind not in self._textures:
            texels, height = taylor_transforms(
                self._height_field,
                self.terms,
                origin_at_centre=self.origin_at_centre,
                taper=taper,
                margin=self.margin,
            )
            self._textures[kind] = TaylorTextures(texels, height)
        self.textures = self._textures[kind]
        matrix = rgb_matrix(cie_rgb_matrix=self.quirks.cie_rgb_matrix)
        self.matrix = [[opaque(float(entry)) for entry in row] for row in matrix]

    @property
    def tapers(self) -> bool:
        """Whether the heights are tapered (`taper.py`)."""
        return False

    @property
    def margin(self) -> int:
        """Texels read outside the frequencies that light reaches."""
        raise NotImplementedError

    @property
    def texels_per_term(self) -> int:
        """Texels read per Taylor term and wavelength."""
        raise NotImplementedError

    @property
    def has_free_scale(self) -> bool:
        return self.quirks.relative

    @property
    def coherence_length(self) -> float:
        """L_c in µm."""
        return self._coherence_lengths[0 if self.quirks.fixed_coherence else 1]

    @property
    def terms(self) -> int:
        """The number of Taylor terms."""
        if self._terms is not None:
            return self._terms
        if self.quirks.fixed_terms:
            return self.published_terms
        return terms_for(MAX_TEXTURE_KAPPA * self._height_field.half_range * self._max_height_scale, SERIES_ERROR)

    @property
    def sigma(self) -> float:
        """σ_f = 1/(2πσ_s) in cycles/µm, σ_s = L_c/4, of the window in amplitude, √2 times as wide as in power."""
        return float(np.sqrt(2) * lobe_width(self.coherence_length))

    @property
    def peak(self) -> float:
        return 1 / (float(np.pi) * self.sigma**2)

    def position(self, gain: Gain, wavelength: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return q T = (u T_x, v T_y)/λ, in texels relative to frequency zero, at a wavelength in µm."""
        return gain.u * self.tile_size[0] / wavelength, gain.v * self.tile_size[1] / wavelength

    def power(self, gain: Gain, wavelength: mi.Float, height_scale: mi.Float, active: mi.Bool) -> mi.Float:
        """Evaluate |P(q; κ)|² at a wavelength in µm; it is one for a flat mirror at q = 0."""
        raise NotImplementedError

    def relative_radiance(self, wi: mi.Vector3f, wo: mi.Vector3f, wavelength: mi.Float) -> mi.Float:
        """Evaluate ρ(λ) at a wavelength in nm (eq. 3.11), for an index of 1.5, including shadowing."""
        gain = Gain(wi, wo, self.shadowing, mi.Bool(True))
        power = self.power(gain, mi.Float(wavelength) * 1e-3, mi.Float(1), gain.active)
        return gain.factor * self.fresnel(mi.Float(PUBLISHED_R0), gain) * power

    def fresnel(self, r_0: mi.Float, gain: Gain) -> mi.Float:
        """Return F(ω_o·h)/F(1)."""
        if self.quirks.schlick or not self.exact_fresnel:
            return (r_0 + (1 - r_0) * gain.falloff) / r_0
        root = dr.sqrt(r_0)
        return mi.fresnel(gain.cos_half, (1 + root) / (1 - root))[0] / r_0

    def integral(self, gain: Gain, weights: SpectralWeights, height_scale: mi.Float) -> mi.Color3f:
        """Integrate F/F₀ |P|² S (x̄, ȳ, z̄) over λ by the trapezoidal rule."""
        return trapezoid(self, self.power, gain, weights, height_scale, gain.active)

    def rgb(
        self,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        weights: SpectralWeights,
        active: mi.Bool = True,
        height_scale: mi.Float = 1.0,
    ) -> mi.Color3f:
        gain = Gain(wi, wo, self.shadowing, mi.Bool(active))
        xyz = gain.factor * self.integral(gain, weights, mi.Float(height_scale))
        return mi.Color3f(*(sum(row[i] * xyz[i] for i in range(3)) for row in self.matrix))

    @property
    def texel_reads(self) -> int:
        return WAVELENGTH_COUNT * self.textures.terms * self.texels_per_term


@dr.syntax
def trapezoid(
    shader: TextureShader,
    power: Callable[[Gain, mi.Float, mi.Float, mi.Bool], mi.Float],
    gain: Gain,
    weights: SpectralWeights,
    height_scale: mi.Float,
    active: mi.Bool,
) -> mi.Color3f:
    """Return Σ_j F/F₀ power(λ_j) S (x̄, ȳ, z̄)(λ_j) Δλ over the 81 wavelengths, with half weight at both ends."""
    result = mi.Color3f(0)
    index = mi.UInt32(0)
    while active & (index < WAVELENGTH_COUNT):
        wavelength = FIRST_WAVELENGTH + WAVELENGTH_STEP * mi.Float(index)
        weight, r_0 = weights(wavelength, active)
        at_end = (index == 0) | (index == WAVELENGTH_COUNT - 1)
        width = dr.select(at_end, 0.5 * WAVELENGTH_STEP, WAVELENGTH_STEP) * shader.fresnel(r_0, gain)
        result += weight * (width * power(gain, wavelength * 1e-3, height_scale, active))
        index += 1
    return result
