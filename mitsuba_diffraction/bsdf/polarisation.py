"""s and p light of a grating: as a plane at the half vector splits them.

docs/validation.md tells how far this is from rigorous results, and why it is worth having.
"""

from __future__ import annotations

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
    half = dr.normalize(wi + wo)
    cos_half = dr.dot(wi, half)
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
    return mi.mueller.rotate_mueller_basis(
        matrix,
        -source,
        axes[0],
        mi.mueller.stokes_basis(-source),
        exit_,
        axes[1],
        mi.mueller.stokes_basis(exit_),
    )
