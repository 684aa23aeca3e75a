"""Comparison of two images: checks, reference images of tests (goldens), limits and report."""
