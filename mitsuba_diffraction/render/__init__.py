"""From a scene to a spectral image."""

from .passes import render
from .scene_file import SceneFile
from .spectral_image import SpectralImage

__all__ = ["SceneFile", "SpectralImage", "render"]
