"""The tables of parameters in docs/plugin.md, from the descriptions of the plugins.

    python tools/manual/parameter_tables.py

writes the page again. A table of the page is a list of names; types, meanings and defaults are those of `PARAMETERS` of
the plugin that the heading above names, or of `diffraction_grating`.
"""

from __future__ import annotations

from pathlib import Path

from mitsuba_diffraction.bsdf import diffraction_grating
from mitsuba_diffraction.integrator import diffraction_path
from mitsuba_diffraction.parameter_documentation import Parameter
from mitsuba_diffraction.shader_2014 import diffraction_shader

PAGE = Path(__file__).parents[2] / "docs" / "plugin.md"
PLUGINS = {module.__name__.rpartition(".")[2]: module for module in (diffraction_path, diffraction_shader)}


def with_tables(text: str) -> str:
    """Return the page with the rows of its tables renewed.

    Raises:
        KeyError: if a table names an unknown parameter.
        ValueError: if a parameter is in no table.
    """
    lines, module, columns, missing = [], diffraction_grating, 0, set[Parameter]()
    for plugin in (diffraction_grating, *PLUGINS.values()):
        missing |= set(plugin.PARAMETERS)
    for line in text.splitlines():
        if line.startswith("## "):
            module = next((PLUGINS[name] for name in PLUGINS if f"`{name}`" in line), diffraction_grating)
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
        raise ValueError(f"{PAGE}: got no row for {', '.join(sorted(parameter.name for parameter in missing))}")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
