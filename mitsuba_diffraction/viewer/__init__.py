"""The live view: a self-contained HTML page that shades a surface in the browser (WebGL2).

`viewed_surface` collects what is shown, `arrays` encodes it, `page` writes the page from the files in `assets`. Nothing
here imports Mitsuba.
"""

from .notebook import view

__all__ = ["view"]
