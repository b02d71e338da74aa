"""Compute the spectra of skins that come with the package: python tools/data/ready_spectra.py

Recipes find them by their digest, as in the cache. To be repeated when a recipe or the computation changes.
"""

from pathlib import Path

from mitsuba_diffraction.precomputation.recipe import READY_SPECTRA, Recipe

RECIPES = Path(__file__).parents[2] / "precompute"
NAMES = ("xenopeltis", "elaphe", "elaphe_afm")


def main() -> None:
    """Compute the files, and remove others."""
    READY_SPECTRA.mkdir(exist_ok=True)
    recipes = [Recipe.load(RECIPES / f"{name}.toml") for name in NAMES]
    for name, recipe in zip(NAMES, recipes, strict=True):
        path = READY_SPECTRA / f"{recipe.digest()}.exr"
        recipe.build().save(path, recipe=recipe.digest())
        print(f"{name}: {path.name}, {path.stat().st_size / 1e6:.2g} MB")
    for other in READY_SPECTRA.glob("*.exr"):
        if other.stem not in {recipe.digest() for recipe in recipes}:
            other.unlink()


if __name__ == "__main__":
    main()
