"""What shading a fragment costs: measured here, compiled for absent GPUs, and as a table."""
