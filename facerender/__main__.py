"""``python -m facerender`` is the command ``facerender``."""

from facerender.commands import console

console()
