"""Comparison of two images: checks, goldens, calibration of limits, report."""
