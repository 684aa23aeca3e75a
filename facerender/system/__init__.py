"""Modules of the operating system: files, the cache, memory, signals and progress."""
