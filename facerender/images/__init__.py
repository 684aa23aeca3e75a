"""Image files: formats, colour profiles, animations."""
