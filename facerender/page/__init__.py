"""Pages that stand alone: one shell, one stylesheet, light and dark, the scripts."""
