"""Prices of shading, estimated by the compilers of GPUs that need not be present, and the price
table of the package: ``python -m benchmarks.prices``."""
