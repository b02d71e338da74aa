"""Evaluation of the product: is it right (validation), and fast (benchmark)?

Imports nothing, so that its offline modules do not load Mitsuba.
"""
