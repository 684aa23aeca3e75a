"""Lights of tests that examine something other than shadows."""

from dataclasses import replace

from facerender.scene.light import LIGHTS

# The lights with names, without area and shadows.
PLAIN = {name: replace(each, radius=0.0, shadow=False) for name, each in LIGHTS.items()}
# A rim light with strong highlights, unlike the default one, in which small changes are visible.
STRONG_RIM = replace(PLAIN["rim"], azimuth=100.0, irradiance=(2.4, 2.5, 2.7))
PLAIN_THREE = (PLAIN["key"], STRONG_RIM, PLAIN["fill"])
