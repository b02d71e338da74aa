"""The spectrum of the phase e^{iκh}: its orders, its table, its file."""

from .grating_spectrum import GratingSpectrum

__all__ = ["GratingSpectrum"]
