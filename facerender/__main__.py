"""``python -m facerender`` is the command ``facerender``."""

from facerender.cli import console

console()
