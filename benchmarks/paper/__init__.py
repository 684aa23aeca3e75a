"""Reproduction of the figures and claims of S. O. Romanyuk et al., Proc. SPIE 11456, 114560E
(2020): ``python -m benchmarks.paper``."""
