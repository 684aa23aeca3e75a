"""Self-contained HTML pages: document, style sheet for light and dark mode, and scripts."""
