"""The commands that compare with the shader of 2014: `compare` and `convergence`."""
