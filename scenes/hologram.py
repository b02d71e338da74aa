"""The textures of hologram.xml: `python scenes/hologram.py`; `mitsuba-diffraction hologram` takes any picture."""

from __future__ import annotations

from pathlib import Path

from modelling import command

from mitsuba_diffraction.inverse_design import hologram

_ROOT = Path(__file__).parents[1]
# A preview (.png), or what gallery.py makes of it; the package itself has no gallery.
PICTURE = next((_ROOT / "docs" / "gallery").glob("snake_xenopeltis_sun.[jp]*g"), _ROOT / "precompute/designed/cat.png")


def make(folder: Path, columns: int = 400) -> None:
    """Write hologram_lateral.exr, hologram_heights.exr and hologram_turn.exr, `columns` pixels wide."""
    hologram.write(PICTURE, folder, columns)


if __name__ == "__main__":
    command(make)
