"""Cost of shading: measured on this machine, or read from a table of drivers and GPUs."""
