"""Mueller matrices of a grating: of a plane at the half vector in scalar theory, exact in rigorous theory.

docs/validation.md compares the matrices of scalar theory with rigorous results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

Split = Callable[..., "mi.Spectrum"]
"""A function that returns the Mueller matrix of a grating from (source, exit, x axis of source, x axis of exit)."""


def reflected(split: Split, wi: mi.Vector3f, wo: mi.Vector3f, mode: mi.TransportMode) -> mi.Spectrum:
    """Return the Mueller matrix of a grating between Mitsuba's own axes.

    Args:
        split: of the grating.
        wi, wo: directions away from the surface, in the shading frame.
        mode: of the transport; it determines from which of the two directions light is incident.
    """
    source, exit_ = (wi, wo) if mode == mi.TransportMode.Importance else (wo, wi)
    return split(source, exit_, mi.mueller.stokes_basis(-source), mi.mueller.stokes_basis(exit_))


def through_layer(
    split: Split,
    eta: mi.UnpolarizedSpectrum,
    outside: Sequence[mi.Vector3f],
    inside: Sequence[Sequence[mi.Vector3f]],
    has_face: Sequence[mi.Bool],
    mode: mi.TransportMode,
) -> mi.Spectrum:
    """Return the Mueller matrix of a grating in a plane layer, with refraction into and out of the layer.

    Args:
        split: of the grating alone, without the transmittances of the layer's face.
        eta: index of the layer at each wavelength, relative to the outside.
        outside, inside: (ω_i, ω_o) in the two media; inside those of each wavelength, or one pair for all of them.
        has_face: whether the face lies between the grating and ω_i, and ω_o.
        mode: of the transport.
    """

    def face(which: int, cos: mi.UnpolarizedSpectrum, eta: mi.UnpolarizedSpectrum) -> mi.Spectrum:
        matrix = mi.mueller.specular_transmission(cos, eta)
        return dr.select(has_face[which], matrix, mi.mueller.absorber(mi.UnpolarizedSpectrum(1)))

    first, last = (0, 1) if mode == mi.TransportMode.Importance else (1, 0)
    # Directions inside and outside have the same plane of refraction, and therefore the same s axis.
    across = [_across(outside[which]) for which in (first, last)]
    matrices = [split(pair[first], pair[last], *across) for pair in inside]
    grating = matrices[0] if len(matrices) == 1 else _of_each_wavelength(matrices)
    cosines = [mi.UnpolarizedSpectrum(dr.abs(omega.z)) for omega in outside]
    cos_inside = dr.safe_sqrt(1 - (1 - dr.square(cosines[last])) / dr.square(eta))
    matrix = face(last, cos_inside, 1 / eta) @ grating @ face(first, cosines[first], eta)
    source, exit_ = outside[first], outside[last]
    bases = mi.mueller.stokes_basis(-source), mi.mueller.stokes_basis(exit_)
    return mi.mueller.rotate_mueller_basis(matrix, -source, across[0], bases[0], exit_, across[1], bases[1])


def of_facets(
    value: mi.UnpolarizedSpectrum, planes: Callable[[mi.Float, mi.Bool], list[mi.Matrix4f]], eta: mi.Float
) -> Split:
    """Return the matrix of a plane perpendicular to h, the normal of the facet that reflects or refracts a pair.

    Args:
        value: R K G E S/λ² cos θ_o of unpolarised light, with R the mean of R_s and R_p at the half vector; or the
            value of transmitted light.
        planes: returns the matrices between s axes at each wavelength, up to a factor, from the cosine of the direction
            of incidence and h, negative from below, and from whether light is reflected.
        eta: index below relative to the index above.
    """

    def split(source: mi.Vector3f, exit_: mi.Vector3f, source_axis: mi.Vector3f, exit_axis: mi.Vector3f) -> mi.Spectrum:
        n_i, n_o = (dr.select(omega.z > 0, 1, eta) for omega in (source, exit_))
        half = dr.normalize(n_i * source + n_o * exit_)
        # The matrix of transmitted light, up to a factor, is the same from above and from below.
        reflects = (source.z > 0) == (exit_.z > 0)
        cos_half = dr.abs(dr.dot(dr.select(reflects | (source.z > 0), source, exit_), half))
        found = planes(dr.select(reflects & (source.z < 0), -cos_half, cos_half), reflects)
        # For equal indices all entries and `value` are zero.
        intensities = [dr.select(plane[0, 0] > 0, plane[0, 0], 1) for plane in found]
        relative = [
            [[plane[i, j] / intensity for j in range(4)] for i in range(4)]
            for plane, intensity in zip(found, intensities, strict=True)
        ]
        # The s axes are perpendicular to the plane of reflection; for retroreflection, to h.
        axes = [dr.cross(half, -source), dr.cross(half, exit_)]
        is_retroreflected = dr.squared_norm(axes[0]) < 1e-12
        across = mi.coordinate_system(half)[0]
        axes = [dr.select(is_retroreflected, across, dr.normalize(axis)) for axis in axes]
        return mi.mueller.rotate_mueller_basis(
            _matrix(value, relative), -source, axes[0], source_axis, exit_, axes[1], exit_axis
        )

    return split


def of_orders(
    value: mi.UnpolarizedSpectrum,
    entries: Callable[[int, mi.Vector3f, mi.Vector3f], list[list[mi.Float]]],
    grooves: mi.Vector3f,
) -> Split:
    """Return the matrix of rigorous theory, scaled to `value` for unpolarised light.

    Args:
        value: Σ_m η_m N/λ² cos θ_o.
        entries: M_ij / M_00 for (channel, source, exit), between waves whose x axis is the component of the grooves
            perpendicular to their direction.
        grooves: ŷ of the pattern.
    """

    def split(source: mi.Vector3f, exit_: mi.Vector3f, source_axis: mi.Vector3f, exit_axis: mi.Vector3f) -> mi.Spectrum:
        matrix = _matrix(value, [entries(channel, source, exit_) for channel in range(len(value))])
        axes = [dr.normalize(grooves - dr.dot(grooves, omega) * omega) for omega in (source, exit_)]
        return mi.mueller.rotate_mueller_basis(matrix, -source, axes[0], source_axis, exit_, axes[1], exit_axis)

    return split


def _matrix(value: mi.UnpolarizedSpectrum, entries: list[list[list[mi.Float]]]) -> mi.Spectrum:
    """Return `value` times M_ij of each channel, `entries[channel][i][j]`."""
    matrix = mi.Spectrum(0.0)
    for row in range(4):
        for column in range(4):
            entry = mi.UnpolarizedSpectrum(0.0)
            for channel, of_channel in enumerate(entries):
                entry[channel] = value[channel] * of_channel[row][column]
            matrix[row, column] = entry
    return matrix


def _of_each_wavelength(matrices: list[mi.Spectrum]) -> mi.Spectrum:
    """Return the matrix whose wavelengths are each from a matrix of its own."""
    result = mi.Spectrum(0.0)
    for row in range(4):
        for column in range(4):
            entries = [matrix[row, column][channel] for channel, matrix in enumerate(matrices)]
            result[row, column] = mi.UnpolarizedSpectrum(entries)
    return result


def _across(omega: mi.Vector3f) -> mi.Vector3f:
    """Return the s axis of refraction, perpendicular to ω and to the surface normal."""
    length = dr.sqrt(dr.square(omega.x) + dr.square(omega.y))
    oblique = length > 1e-6
    scale = dr.rcp(dr.select(oblique, length, 1))
    return dr.select(oblique, mi.Vector3f(-omega.y * scale, omega.x * scale, 0), mi.Vector3f(0, 1, 0))
