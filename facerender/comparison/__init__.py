"""Comparison of two images. Tests of a renderer need one that detects a broken highlight of a few
pixels, and passes the differences between OpenGL drivers, which change every edge a little.

``compare`` takes two images and returns a :class:`Comparison`: metrics, limits, and reasons with a
likely cause. ``sources`` reads and checks the images, ``windows`` computes the metrics and
``causes`` the cause; ``calibration`` finds limits for other renderers. ``goldens``, ``report`` and
``pictures`` serve the pytest plugin and the command. After ``sources``, images have one size, equal
channels and finite values: the metrics check nothing again, and pixels that do not count are 0."""
