"""The evaluation of the thesis of 2014 (chapter 5), for the real-time shader and for this project's model."""

from .figures import figure_names, save_figures

__all__ = ["figure_names", "save_figures"]
