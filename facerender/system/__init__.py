"""Files, cache, memory, signals and progress."""

import os

# Id of the process that imported the package. A module that is imported after a fork compares this
# id with os.getpid() to detect the fork.
IMPORTER = os.getpid()
