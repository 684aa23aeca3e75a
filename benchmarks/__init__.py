"""Measurements of the project: speed beside other programs, the paper's claims, prices by other
compilers. They run from the repository's root and are not installed."""
