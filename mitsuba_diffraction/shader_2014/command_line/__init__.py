"""The command that compares with the shader of 2014: `compare`."""
