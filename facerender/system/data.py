"""Folders of data files."""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]


def data_dir(name: str) -> Path:
    """Return the data folder ``name``: in the installed package, or next to it in a checkout."""
    installed = _PACKAGE / name
    return installed if installed.is_dir() else _PACKAGE.parent / name
