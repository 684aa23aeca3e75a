"""Files, the cache, memory, signals and progress."""

import os

# The process that imported the package. A module that is imported later, in a child, compares it
# with its own to learn of a fork that no hook of its own has seen.
IMPORTER = os.getpid()
