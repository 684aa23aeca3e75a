"""Benchmarks: speed compared with other programs, the claims of the paper, prices from other
compilers. Run them from the root of the repository; they are not installed."""
