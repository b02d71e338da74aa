"""Formulas that all parts share: directions and K G, refractive indices, planes under films, colours."""
