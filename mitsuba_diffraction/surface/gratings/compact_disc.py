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
    tracks: int = 20,
    length: float = 32.0,
    pixel_size: float = 0.05,
    seed: int = 0,
) -> HeightField:
    """The metal of a compact disc.

    Tracks run along y and diffract along x. On Mitsuba's `disk` x is radial, so that an orientation of 0 is correct.

    From the standard (IEC 60908; ECMA-130 for the CD-ROM): a track pitch of 1.6 ± 0.1 µm, a substrate of index 1.55 ±
    0.1, pits and lands of 3 to 11 channel bits of T = 1/4.3218 MHz, which at 1.2 m/s are 0.2777 µm, so 0.83 to 3.05 µm.
    Depth and width are specified only indirectly, by the signals of a player; 0.11 µm and 0.55 µm are typical (λ/4n =
    0.126 µm at 780 nm maximises contrast, λ/8n the tracking signal). The lengths of pits and lands are random with the
    maximum-entropy distribution under that constraint.

    The pits are those of the metal, as an instrument measures them once the polycarbonate is off. The disc as one holds
    it has a layer of it: `coat_ior` = 1.55 of the plugin.

    Args:
        period: track pitch, µm.
        depth: geometric depth of the pits, µm.
        width: of the pits at half their depth, µm.
        channel_bit: length of a channel bit along the track, µm.
        tracks: number of tracks; times the period, the size of the patch along x.
        length: of the patch along y, µm, rounded to whole channel bits.
        pixel_size: µm, adjusted to a whole number of pixels per patch.
        seed: random seed.

    Returns:
        The patch, which tiles seamlessly; pits protrude towards the light.

    Raises:
        ValueError: if a length is not positive, the depth negative, the pits wider than they are
            long or than the track, the patch shorter than four pits, or the pixels too coarse.
    """
    return draw_tracks(
        period=period,
        depth=depth,
        width=width,
        channel_bit=channel_bit,
        tracks=tracks,
        length=length,
        pixel_size=pixel_size,
        seed=seed,
        runs=EIGHT_TO_FOURTEEN,
        name="compact disc",
    )
