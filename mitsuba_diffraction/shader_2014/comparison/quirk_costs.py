"""Cost of each quirk of the published shader: what it adds to the difference from this model in the same light."""

from __future__ import annotations

from dataclasses import dataclass

from .difference import difference, white_luminance
from .pictures import Pictures, Progress, silent

MIN_EFFECT = 0.5
"""Mean CIEDE2000, half of a just noticeable difference. Noise is less, as all pictures have the same points."""


@dataclass(frozen=True)
class QuirkCost:
    """One quirk.

    Attributes:
        drop: of the mean CIEDE2000 of the published shader, when this quirk alone is corrected.
        rise: of the mean CIEDE2000 of the corrected shader, when this quirk alone is added.
        fraction: (drop + rise)/2 over the mean CIEDE2000 of the published shader.
    """

    drop: float
    rise: float
    fraction: float


@dataclass(frozen=True)
class QuirkCosts:
    """Effect of each quirk on the difference.

    `drop` is the effect of a quirk in the presence of all others, `rise` its effect alone; the fraction is the mean of
    both, relative to the difference. Fractions do not add up to one, and may be negative: two quirks may cancel, or one
    may mask another. The brightness of each picture is fitted anew, unless one is given.

    Attributes:
        size: (width, height) of the pictures.
        samples: per pixel of the BSDFs other than gratings.
        shading_points: per pixel of the gratings.
        published: mean CIEDE2000 of the shader as published.
        corrected: of the shader without quirks.
        quirks: by name, largest fraction first.
    """

    size: tuple[int, int]
    samples: int
    shading_points: int
    published: float
    corrected: float
    quirks: dict[str, QuirkCost]

    def visible(self) -> list[str]:
        """Return the names of the quirks whose drop or rise exceeds `MIN_EFFECT`."""
        return [name for name, one in self.quirks.items() if max(abs(one.drop), abs(one.rise)) > MIN_EFFECT]


def quirk_costs(pictures: Pictures, samples: int, shading_points: int, progress: Progress = silent) -> QuirkCosts:
    """Render the shader with each single quirk corrected, and with each single quirk added.

    Args:
        pictures: of a small size.
        samples: per pixel of the BSDFs other than gratings.
        shading_points: per pixel of the gratings.
        progress: called with (pictures done, pictures in total).
    """
    names = pictures.quirks
    done, total = 1, 2 * len(names) + 3
    reference = pictures.same_light(shading_points, samples)
    progress(1, total)
    white = white_luminance(reference.xyz, pictures.mask)

    def distance(*quirks: str) -> float:
        nonlocal done
        xyz = pictures.shaded(quirks, shading_points, samples).xyz
        done += 1
        progress(done, total)
        return difference(reference.xyz, xyz, pictures.mask, white).mean

    published, corrected = distance(*names), distance()
    found = {}
    for name in names:
        drop, rise = published - distance(*(other for other in names if other != name)), distance(name) - corrected
        found[name] = QuirkCost(drop, rise, (drop + rise) / 2 / published)
    rows, columns = pictures.mask.shape
    return QuirkCosts(
        (columns, rows),
        samples,
        shading_points,
        published=published,
        corrected=corrected,
        quirks=dict(sorted(found.items(), key=lambda item: item[1].fraction, reverse=True)),
    )
