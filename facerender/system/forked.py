"""The process that imported the package. What is imported later, in a child, tells by it that there
was a fork."""

import os

IMPORTER = os.getpid()
