"""Fits of constants in the package and in the shader library; needs SciPy."""
