"""What the published shader does otherwise than the physics asks for, each a switch of its own."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..errors import RequestError


@dataclass(frozen=True)
class Quirks:
    """Each attribute is true "as published" and false "corrected"; equations are those of the thesis of 2014.

    Attributes:
        fresnel_squared: F² with Schlick's F, which is a power already (eq. 3.4, 3.10); corrected: F.
        fixed_index: F is that of an index of 1.5 whatever the material is; corrected: R at normal incidence is given.
        window_pi: the Gaussian window has the height π (eq. 3.30); corrected: 1, so that a flat mirror gives one.
        complex_window_sum: |Σ φ F|², the average ⟨·⟩ over places is dropped; corrected: Σ φ² |F|².
        floor_anchor: the neighbourhood is centred at ⌊·⌋ of the position among the texels (algorithm 4.3, lines 12 and
            13); corrected: at the nearest texel.
        heights_from_zero: the heights run from 0 to their range (algorithm 4.1); corrected: about the middle, which
            needs half of the Taylor terms and loses fewer digits.
        no_jacobian: NMM adds up its wavelengths without dλ/dn; corrected: each stands for the area of its line.
        wrong_product: PQ's imaginary part of a product is p₁p₂ + q₁q₂ (eq. 3.48); corrected: p₁q₂ + q₁p₂.
        d65_light: the light is D65, whatever the scene says; corrected: the spectrum of the light.
        relative: the radiance is relative to a flat mirror, which drops R₀ S(0)/λ² (eq. 3.7); corrected: radiance.
        d65_twice: XYZ, weighted with D65 already, is multiplied by D65's white point (eq. 4.10); corrected: once.
        cie_rgb_matrix: XYZ becomes CIE RGB and is shown as if it were sRGB (eq. 4.9); corrected: sRGB.
        power_gamma: the picture is encoded with a power of 1/2.2; corrected: with sRGB's transfer function.
        constant_blend: a surface below is blended in with a constant weight (algorithm 4.4, whose test |F| > 1 no
            reflectance meets); corrected: it gets what the surface lets through, (1 − R_i)(1 − R_o).
        infrared_rainbow: GEM's rainbow spans 0.5 to 1 µm; corrected: 0.38 to 0.78 µm.
    """

    fresnel_squared: bool
    fixed_index: bool
    window_pi: bool
    complex_window_sum: bool
    floor_anchor: bool
    heights_from_zero: bool
    no_jacobian: bool
    wrong_product: bool
    d65_light: bool
    relative: bool
    d65_twice: bool
    cie_rgb_matrix: bool
    power_gamma: bool
    constant_blend: bool
    infrared_rainbow: bool

    def __post_init__(self) -> None:
        for field in fields(self):
            if not isinstance(getattr(self, field.name), bool):
                raise RequestError(f"{field.name}: got {getattr(self, field.name)!r}, wanted True or False")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names of the switches."""
        return tuple(field.name for field in fields(cls))

    @classmethod
    def as_published(cls) -> Quirks:
        """All on."""
        return cls(**dict.fromkeys(cls.names(), True))

    @classmethod
    def corrected(cls) -> Quirks:
        """All off."""
        return cls(**dict.fromkeys(cls.names(), False))
