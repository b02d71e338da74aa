"""From a scene to a spectral image."""

from .passes import render
from .spectral_image import SpectralImage

__all__ = ["SpectralImage", "render"]
