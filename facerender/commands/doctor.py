"""``facerender doctor``."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys

from facerender import store
from facerender._version import __version__
from facerender.commands.streams import tell
from facerender.drawing.context import probe


def add(doctor: argparse.ArgumentParser) -> None:
    doctor.set_defaults(command=run)
    doctor.add_argument("--json", action="store_true", help="print the findings as JSON")


def run(options: argparse.Namespace) -> int:
    findings = probe()
    if options.json:
        tell(json.dumps([dataclasses.asdict(finding) for finding in findings], indent=2))
    else:
        tell(f"facerender {__version__}, Python {sys.version.split()[0]}")
        for finding in findings:
            if finding.error:
                tell(f"{finding.backend:7} {finding.error}")
            else:
                tell(
                    f"{finding.backend:7} {finding.renderer}, OpenGL {finding.version}, "
                    f"up to {finding.samples} samples and {finding.size} pixels a side"
                )
        used, most = store.size() >> 20, store.limit() >> 20
        tell(f"cache   {store.folder()}, {used} of at most {most} MiB")
    return 0 if any(not finding.error for finding in findings) else 2
