"""Evaluation of the product: validation, benchmark, and comparison with the real-time shader.

Imports nothing, so that its offline modules do not load Mitsuba.
"""
