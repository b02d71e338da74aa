"""s and p light of a grating: as a plane at the half vector splits them.

docs/validation.md tells how far this is from rigorous results, and why it is worth having.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi


def reflected(
    value: mi.UnpolarizedSpectrum,
    index: list[mi.Complex2f],
    wi: mi.Vector3f,
    wo: mi.Vector3f,
    mode: mi.TransportMode,
) -> mi.Spectrum:
    """The Mueller matrix of the grating: that of a plane across h, scaled to `value` for unpolarised light.

    Args:
        value: R K G E S/λ² cos θ_o, R the mean of R_s and R_p at the half vector.
        index: n + ik of every wavelength, relative to the outside.
        wi, wo: towards the light and away from the surface, in the shading frame, above the surface.
        mode: of the transport; it tells which of the two the light comes from.
    """
    source, exit_ = (wi, wo) if mode == mi.TransportMode.Importance else (wo, wi)
    return _between(value, index, source, exit_, mi.mueller.stokes_basis(-source), mi.mueller.stokes_basis(exit_))


def through_layer(
    value: mi.UnpolarizedSpectrum,
    index: list[mi.Complex2f] | None,
    eta: mi.Float,
    outside: Sequence[mi.Vector3f],
    inside: Sequence[mi.Vector3f],
    mode: mi.TransportMode,
) -> mi.Spectrum:
    """The Mueller matrix of a grating under a plane layer: refraction in, `reflected` inside, refraction out.

    Args:
        value: of the grating alone, without the transmittances of the layer's face.
        index: relative to the layer, or None for a grating that leaves light unpolarised.
        eta: index of the layer, relative to the outside.
        outside, inside: (ω_i, ω_o) in the two media.
        mode: of the transport.
    """
    first, last = (0, 1) if mode == mi.TransportMode.Importance else (1, 0)
    # The plane of refraction is spanned by the normal and the direction, inside and outside.
    across = [_across(outside[which]) for which in (first, last)]
    grating = (
        mi.depolarizer(value)
        if index is None
        else _between(value, index, inside[first], inside[last], across[0], across[1])
    )
    enter = mi.mueller.specular_transmission(mi.UnpolarizedSpectrum(outside[first].z), mi.UnpolarizedSpectrum(eta))
    leave = mi.mueller.specular_transmission(mi.UnpolarizedSpectrum(inside[last].z), mi.UnpolarizedSpectrum(1 / eta))
    matrix = leave @ grating @ enter
    source, exit_ = outside[first], outside[last]
    return mi.mueller.rotate_mueller_basis(
        matrix,
        -source,
        across[0],
        mi.mueller.stokes_basis(-source),
        exit_,
        across[1],
        mi.mueller.stokes_basis(exit_),
    )


def _across(omega: mi.Vector3f) -> mi.Vector3f:
    """The s axis of refraction: across the direction and the surface's normal."""
    length = dr.sqrt(dr.square(omega.x) + dr.square(omega.y))
    oblique = length > 1e-6
    scale = dr.rcp(dr.select(oblique, length, 1))
    return dr.select(oblique, mi.Vector3f(-omega.y * scale, omega.x * scale, 0), mi.Vector3f(0, 1, 0))


def _between(
    value: mi.UnpolarizedSpectrum,
    index: list[mi.Complex2f],
    source: mi.Vector3f,
    exit_: mi.Vector3f,
    source_axis: mi.Vector3f,
    exit_axis: mi.Vector3f,
) -> mi.Spectrum:
    """`reflected`, from light whose x axis is `source_axis` to light whose x axis is `exit_axis`."""
    half = dr.normalize(source + exit_)
    cos_half = dr.dot(source, half)
    planes = [mi.mueller.specular_reflection(cos_half, eta) for eta in index]
    # Where nothing is reflected (indices that match) `value` is zero, and so is every entry.
    brightness = [dr.select(plane[0, 0] > 0, plane[0, 0], 1) for plane in planes]
    matrix = mi.Spectrum(0.0)
    for row in range(4):
        for column in range(4):
            entry = mi.UnpolarizedSpectrum(0.0)
            for channel, plane in enumerate(planes):
                entry[channel] = value[channel] * plane[row, column] / brightness[channel]
            matrix[row, column] = entry
    # The s axes lie across the plane of reflection; for light that returns to its source any axis across it will do.
    axes = [dr.cross(half, -source), dr.cross(half, exit_)]
    returns = dr.squared_norm(axes[0]) < 1e-12
    across = mi.coordinate_system(half)[0]
    axes = [dr.select(returns, across, dr.normalize(axis)) for axis in axes]
    return mi.mueller.rotate_mueller_basis(matrix, -source, axes[0], source_axis, exit_, axes[1], exit_axis)
