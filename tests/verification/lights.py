"""Lights of tests that examine something other than shadows."""

from dataclasses import replace

from facerender.scene.light import LIGHTS

# The lights with names, without area and shadows.
PLAIN = {name: replace(each, radius=0.0, shadow=False) for name, each in LIGHTS.items()}
PLAIN_THREE = (PLAIN["key"], PLAIN["rim"], PLAIN["fill"])
