"""Surfaces for other programs: orders as a table, a grating for Zemax OpticStudio and Speos, a shader for Cycles."""
