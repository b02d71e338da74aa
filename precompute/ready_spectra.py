"""Computes the spectra of skins that the package brings: python precompute/ready_spectra.py

Recipes find them by their digest, as in the cache. To be repeated when a recipe or what is computed from it changes.
"""

from pathlib import Path

from mitsuba_diffraction.recipe import READY_SPECTRA, Recipe

NAMES = ("xenopeltis", "elaphe", "elaphe_afm")


def main() -> None:
    """Replaces the files."""
    READY_SPECTRA.mkdir(exist_ok=True)
    recipes = [Recipe.load(Path(__file__).with_name(f"{name}.toml")) for name in NAMES]
    for old in READY_SPECTRA.glob("*.exr"):
        old.unlink()
    for name, recipe in zip(NAMES, recipes, strict=True):
        path = READY_SPECTRA / f"{recipe.digest()}.exr"
        recipe.build().save(path, recipe=recipe.digest())
        print(f"{name}: {path.name}, {path.stat().st_size / 1e6:.2g} MB")


if __name__ == "__main__":
    main()
