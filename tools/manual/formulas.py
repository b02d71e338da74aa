"""The formulas of the manual: a hook of MkDocs (mkdocs.yml) that turns blocks of LaTeX into MathML.

Browsers typeset MathML themselves: pages need no script and no fonts of other servers. GitHub shows the same blocks.
"""

from __future__ import annotations

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig


def formula(source: str, *_: object, **__: object) -> str:
    """Return a block ```math as HTML."""
    return f'<div class="formula">{convert(source, display="block")}</div>'


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Enter the blocks in the extension `superfences`, whose functions YAML cannot name before hooks are loaded."""
    fence = {"name": "math", "class": "formula", "format": formula}
    config.mdx_configs["pymdownx.superfences"] = {"custom_fences": [fence]}
    return config
