"""Brings scenes and recipes into the package when it is built; everything else is in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithExamples(build_py):
    """Copies what the command `examples` gives out; from a checkout, it takes it from there."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        examples = Path(self.build_lib) / "mitsuba_diffraction" / "examples"
        shutil.rmtree(examples, ignore_errors=True)
        examples.mkdir()
        shutil.copy("LICENSE", examples)  # for the extension of Blender
        for folder in ("scenes", "precompute"):
            # What the scenes' scripts and earlier renderings left, what judges figures of the manual, and two reliefs
            # of the gallery, which are too large; textures of the scenes lie in folders of their own.
            reliefs = ("cat_fine.*", "diffract.*")
            left = shutil.ignore_patterns("models", "out", "gallery.*", "published", *reliefs, "__pycache__", ".*")
            shutil.copytree(folder, examples / folder, ignore=left)
            for picture in (examples / folder).glob("*.exr"):
                picture.unlink()


setup(cmdclass={"build_py": BuildWithExamples})
