"""Surfaces: height fields, where they come from, how scans are prepared, and what periods they have."""
