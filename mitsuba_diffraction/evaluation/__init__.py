"""Evaluation of the product: validation, benchmark, and comparison with the real-time shader.

Imports nothing, so that what is offline in here stays offline.
"""
