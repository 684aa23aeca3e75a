"""Batches: many jobs from a table, drawn in chunks by several workers."""
