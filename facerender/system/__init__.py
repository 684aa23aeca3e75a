"""Files, the disk cache, memory, signals and progress: all that depends on the operating system.

The package exists so that no other package handles a system error, a signal or a partial file.
Paths and bytes flow in and out. Rules: only regular files of limited size are read, and an output
is written completely or not at all, also if a signal ends the process."""

import os

# Id of the process that imported the package. A module that is imported after a fork compares this
# id with os.getpid() to detect the fork.
IMPORTER = os.getpid()
