"""Surfaces: height fields, profiles and readers, preparation of scans, and periods."""
