"""Entry point of ``facerender`` and ``python -m facerender``. It installs signal handlers before
the imports, which take most of a short run."""

from typing import NoReturn

from facerender.system.signals import heed_signals


def console() -> NoReturn:
    """Run the command and end the process."""
    heed_signals()
    from facerender.commands import console

    console()


if __name__ == "__main__":
    console()
