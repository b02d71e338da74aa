"""What measures the product: against theory, rigorous theory and the shader, and speed against error.

Imports nothing, so that what is offline in here stays offline.
"""
