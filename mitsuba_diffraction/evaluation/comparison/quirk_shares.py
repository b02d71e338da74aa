"""Fraction of the difference to a reference that is due to each quirk of the published shader."""

from __future__ import annotations

from dataclasses import dataclass

from .difference import difference, noise, white_luminance
from .pictures import Pictures, Progress, silent


@dataclass(frozen=True)
class QuirkShare:
    """One quirk against one reference.

    Attributes:
        drop: of the mean CIEDE2000 of the published shader, when this quirk alone is corrected.
        rise: of the mean CIEDE2000 of the corrected shader, when this quirk alone is added.
        share: (drop + rise)/2 over the mean CIEDE2000 of the published shader.
    """

    drop: float
    rise: float
    share: float


@dataclass(frozen=True)
class AgainstReference:
    """The quirks against one reference.

    Attributes:
        published: mean CIEDE2000 of the shader as published.
        corrected: of the shader without quirks.
        noise: of the reference; None if it has one sample per pixel.
        quirks: by name.
    """

    published: float
    corrected: float
    noise: float | None
    quirks: dict[str, QuirkShare]


@dataclass(frozen=True)
class QuirkShares:
    """Fractions of the difference due to each quirk.

    `drop` is the effect of a quirk in the presence of all others, `rise` its effect alone; the fraction is the mean of
    both, relative to the difference. Fractions do not add up to one, and may be negative: two quirks may cancel, or one
    may mask another.

    Attributes:
        size: (width, height) of the pictures.
        samples: per pixel of the path tracer.
        shading_points: per pixel of the shader.
        path_traced: against the path tracer's picture.
        same_light: against the project's model under the lights that the shader supports.
    """

    size: tuple[int, int]
    samples: int
    shading_points: int
    path_traced: AgainstReference
    same_light: AgainstReference


def quirk_shares(pictures: Pictures, samples: int, shading_points: int, progress: Progress = silent) -> QuirkShares:
    """Render the shader with each single quirk corrected, and with each single quirk added.

    Args:
        pictures: of a small size.
        samples: per pixel of the references.
        shading_points: per pixel of the shader.
        progress: called with (pictures done, pictures in total).
    """
    names = pictures.quirks
    done, total = 2, 2 * len(names) + 4
    references = [pictures.path_traced(samples)]
    progress(1, total)
    references.append(pictures.same_light(shading_points, samples))
    progress(2, total)
    white = white_luminance(references[0].xyz, pictures.surface)

    def distances(quirks: tuple[str, ...]) -> list[float]:
        """Compare with both references."""
        nonlocal done
        xyz = pictures.shaded(quirks, shading_points, samples).xyz
        done += 1
        progress(done, total)
        return [difference(reference.xyz, xyz, pictures.surface, white).mean for reference in references]

    published, corrected = distances(names), distances(())
    without = {name: distances(tuple(other for other in names if other != name)) for name in names}
    alone = {name: distances((name,)) for name in names}

    def against(index: int) -> AgainstReference:
        quirks = {}
        for name in names:
            drop, rise = published[index] - without[name][index], alone[name][index] - corrected[index]
            quirks[name] = QuirkShare(drop, rise, (drop + rise) / 2 / published[index])
        floor = noise(references[index].halves, pictures.surface, white)
        return AgainstReference(published[index], corrected[index], floor, quirks)

    rows, columns = pictures.surface.shape
    return QuirkShares((columns, rows), samples, shading_points, path_traced=against(0), same_light=against(1))
