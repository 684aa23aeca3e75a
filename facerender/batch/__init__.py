"""Batch rendering: draws the jobs of a table in chunks with several workers."""
