"""The commands that judge the product: `validate`, `benchmark` and `convergence`."""
