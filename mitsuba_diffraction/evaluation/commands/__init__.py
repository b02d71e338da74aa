"""The commands that judge the product: compare, convergence, validate, benchmark."""
