"""The tables of parameters in docs/plugin.md and docs/integrators.md, from the descriptions of the plugins.

    python tools/manual/parameter_tables.py

writes the pages again. A table of a page is a list of names; types, meanings and defaults are those of `PARAMETERS` of
the plugin that the heading above names, or of the first plugin of the page.
"""

from __future__ import annotations

from pathlib import Path

from mitsuba_diffraction.bsdf import diffraction_grating
from mitsuba_diffraction.integrator import diffraction_path
from mitsuba_diffraction.parameter_documentation import Parameter
from mitsuba_diffraction.shader_2014 import diffraction_shader

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {"plugin.md": (diffraction_grating,), "integrators.md": (diffraction_path, diffraction_shader)}
"""The plugins that a page describes."""


def with_tables(name: str, text: str) -> str:
    """Return the text of the page of `PAGES` with the rows of its tables renewed.

    Raises:
        KeyError: if a table names an unknown parameter.
        ValueError: if a parameter is in no table.
    """
    plugins = {module.__name__.rpartition(".")[2]: module for module in PAGES[name]}
    lines, module, columns, missing = [], PAGES[name][0], 0, set[Parameter]()
    for plugin in plugins.values():
        missing |= set(plugin.PARAMETERS)
    for line in text.splitlines():
        if line.startswith("## "):
            module = next((plugins[plugin] for plugin in plugins if f"`{plugin}`" in line), PAGES[name][0])
        if line.startswith("| parameter |"):
            columns = line.count("|") - 1
        elif not line.startswith("|"):
            columns = 0
        elif columns and not line.startswith("|---"):
            known = {parameter.name: parameter for parameter in module.PARAMETERS}
            parameter = known[line.split("|")[1].strip().replace("`", "")]
            missing.discard(parameter)
            names = ", ".join(f"`{name}`" if name != "…" else name for name in parameter.name.split(", "))
            cells = [names, parameter.type, parameter.meaning, parameter.default][:columns]
            line = f"| {' | '.join(cells)} |".replace("|  |", "| |")
        lines.append(line)
    if missing:
        raise ValueError(f"{name}: got no row for {', '.join(sorted(parameter.name for parameter in missing))}")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    for page in PAGES:
        (DOCS / page).write_text(with_tables(page, (DOCS / page).read_text(encoding="utf-8")), encoding="utf-8")
