"""Files, cache, memory, signals and progress."""

import os

# The process that imported the package. A module that is imported after a fork compares this with
# os.getpid() to detect the fork.
IMPORTER = os.getpid()
