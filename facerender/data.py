"""Where the files lie that are no code: in the wheel, or in the checkout."""

from pathlib import Path


def data_dir(name: str) -> Path:
    """Return the folder ``name`` of the package's data: in the wheel, or in the checkout."""
    installed = Path(__file__).parent / name
    return installed if installed.is_dir() else Path(__file__).parents[1] / name
