"""Measurements that the tests and the documents share: cases of every shader function and their
targets, deliberately broken renders, pairs of images, scenes for plans, and two heads."""
