"""The tables of parameters of the manual: a hook of MkDocs (mkdocs.yml) that marks them.

Their cells are sentences. On narrow screens the style sheet shows each row as an entry of a list.
"""

from __future__ import annotations

import re

_PARAMETERS = re.compile(r"<table>(?=\s*<thead>\s*<tr>\s*<th[^>]*>(?:parameter|option|command)</th>)")


def on_page_content(html: str, **_: object) -> str:
    """Give the tables that begin with a column of names the class `parameters`."""
    return _PARAMETERS.sub('<table class="parameters">', html)
