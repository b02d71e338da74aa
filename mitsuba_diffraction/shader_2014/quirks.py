"""The quirks of the published shader: deviations from the physics, each of which can be toggled."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..errors import RequestError


@dataclass(frozen=True)
class Quirks:
    """True means "as published", false "corrected"; equations have the numbers of the thesis of 2014.

    "As published" is what made the published pictures. Where the text of the thesis differs from them, its version is
    not emulated; docs/thesis.md lists these differences.

    Attributes:
        schlick: Schlick's approximation (eq. B.1), at 60° a fifth too low for an index of 1.5; corrected: the Fresnel
            reflectance of a dielectric; a conductor keeps Schlick's.
        fixed_index: F has an index of 1.5 for any material; corrected: R at normal incidence of the material.
        complex_window_sum: |Σ φ F|² without the spatial average ⟨·⟩; corrected: Σ φ² |F|².
        one_texel: the neighbourhood is one texel on each side (section 4.4.1); corrected: as many as
            span 4σ_f (section 4.3.2).
        floor_anchor: the neighbourhood is centred at ⌊·⌋ of the texel position (algorithm 4.3, lines 12 and 13);
            corrected: at the nearest texel.
        fixed_coherence: the window has a coherence length of 65 µm; corrected: the coherence length of the recipe.
        periodic_scan: a scan, a piece of an irregular surface, is one period of a tiling with seams; corrected: it is
            tapered by the mean of the windows with which this model averages over the scan (`taper.py`).
        fixed_terms: the published number of Taylor terms for any surface; corrected: as many as an error of 1e-4
            requires.
        no_jacobian: NMM sums its wavelengths without dλ/dn; corrected: each represents the area of its line.
        wrong_product: the imaginary part of a product in PQ is p₁p₂ + q₁q₂ (eq. 3.48); corrected: p₁q₂ + q₁p₂.
        d65_light: the light is D65; corrected: the spectrum of the light in the scene.
        relative: radiance is relative to a flat mirror, which omits R₀ S(0)/λ² (eq. 3.7), times a free brightness;
            corrected: radiance.
        cie_rgb_matrix: XYZ is converted to CIE RGB but displayed as sRGB (eq. 4.9); corrected: sRGB.
        constant_blend: the layer below is blended with a constant weight (algorithm 4.4, whose test |F| > 1 is never
            true); corrected: weighted by the transmittance (1 − R_i)(1 − R_o).
    """

    schlick: bool
    fixed_index: bool
    complex_window_sum: bool
    one_texel: bool
    floor_anchor: bool
    fixed_coherence: bool
    periodic_scan: bool
    fixed_terms: bool
    no_jacobian: bool
    wrong_product: bool
    d65_light: bool
    relative: bool
    cie_rgb_matrix: bool
    constant_blend: bool

    def __post_init__(self) -> None:
        for field in fields(self):
            if not isinstance(getattr(self, field.name), bool):
                raise RequestError(f"{field.name}: got {getattr(self, field.name)!r}, wanted True or False")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of all quirks."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def as_published(cls) -> Quirks:
        """Return all quirks switched on."""
        return cls(**dict.fromkeys(cls.names(), True))

    @classmethod
    def corrected(cls) -> Quirks:
        """Return all quirks switched off."""
        return cls(**dict.fromkeys(cls.names(), False))
