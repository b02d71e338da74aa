"""Compact disc: tracks of pits, 1.6 µm apart."""

from __future__ import annotations

from ..heightfield import HeightField
from .tracks import EIGHT_TO_FOURTEEN, draw_tracks


def compact_disc(
    period: float = 1.6,
    depth: float = 0.11,
    *,
    width: float = 0.55,
    channel_bit: float = 0.2777,
    index: float = 1.55,
    tracks: int = 20,
    length: float = 32.0,
    pixel_size: float = 0.0625,
    seed: int = 0,
) -> HeightField:
    """The reflecting layer of a compact disc, as light sees it through the polycarbonate.

    Tracks run along y; the diffracting direction is x. On Mitsuba's `disk` x is the radius, so orientation 0 is right.

    From the standard (IEC 60908; ECMA-130 for the CD-ROM): a track pitch of 1.6 ± 0.1 µm, a substrate of index 1.55 ±
    0.1, pits and lands of 3 to 11 channel bits of T = 1/4.3218 MHz, which at 1.2 m/s are 0.2777 µm, so 0.83 to 3.05 µm.
    Depth and width are bound there only by the signals that a player reads; 0.11 µm and 0.55 µm are usual (λ/4n =
    0.126 µm at 780 nm gives the greatest contrast, λ/8n the best tracking). Pits and lands are drawn at random, their
    lengths as a sequence of greatest information under that constraint has them.

    **Heights are optical depths, index · depth**: the model has one surface, in air. Directions are right (a plane
    layer does not change the grating equation), and so is the phase at normal incidence, 4π n·depth/λ. Off the normal
    light is steeper inside of the disc than outside and the phase falls less than the model's: n (cos θ_i' + cos θ_o')
    against n (cos θ_i + cos θ_o), 2.76 against 2.19 with both at 45°. The mirror image in the disc's front surface
    (4 %) is missing. `index=1` is a disc without its polycarbonate.

    Args:
        period: track pitch, µm.
        depth: of the pits, µm, as an instrument measures it.
        width: of the pits at half their depth, µm.
        channel_bit: length of a channel bit along the track, µm.
        index: refractive index of what covers the layer.
        tracks: how many the patch holds; their number times the period is its size along x.
        length: of the patch along y, µm, rounded to whole channel bits.
        pixel_size: wanted pixel, µm; adjusted so that a whole number of pixels fills the patch.
        seed: of the random numbers.

    Returns:
        The patch, which repeats without seams; pits stand out by index · depth, as they do towards the light.

    Raises:
        ValueError: if a length is not positive, the depth negative, the index below one, the pits wider than they are
            long or than the track, the patch shorter than four pits, or the pixels too coarse.
    """
    return draw_tracks(
        period=period,
        depth=depth,
        width=width,
        channel_bit=channel_bit,
        index=index,
        tracks=tracks,
        length=length,
        pixel_size=pixel_size,
        seed=seed,
        runs=EIGHT_TO_FOURTEEN,
        name="compact disc",
    )
