"""Cost of shading: measured on this machine, or read from a table that includes other GPUs."""
