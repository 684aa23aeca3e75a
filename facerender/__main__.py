"""``python -m facerender`` is the command ``facerender``."""

import sys

from facerender.cli import main

sys.exit(main())
