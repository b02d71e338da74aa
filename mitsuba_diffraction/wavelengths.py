"""The visible range."""

from __future__ import annotations

VISIBLE = (360.0, 830.0)
"""nm: the range of the CIE 1931 observer, from which Mitsuba draws wavelengths."""
