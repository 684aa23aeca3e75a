"""Folders of files that are not code."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def data_dir(name: str) -> Path:
    """Return the folder ``name`` of the wheel's data; in a checkout, that beside the package."""
    installed = _PACKAGE / name
    return installed if installed.is_dir() else _PACKAGE.parent / name
