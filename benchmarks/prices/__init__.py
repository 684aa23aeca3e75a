"""Prices of shading by compilers of GPUs that are not here, and the price table of the package:
``python -m benchmarks.prices``."""
