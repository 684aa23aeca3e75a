"""``facerender doctor``."""

from __future__ import annotations

import argparse
import json
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from facerender import __version__
from facerender.commands.options import add_options
from facerender.commands.output import print_result
from facerender.drawing.context import AUTO, probe
from facerender.system import cache

# Python packages, keyed by the extra that needs them; "" is facerender without extras.
PACKAGES = {
    "": ("moderngl", "glcontext", "numpy", "trimesh", "pyrr", "Pillow", "tqdm"),
    "exr": ("OpenEXR",),
    "hdr": ("OpenImageIO",),
    "draco": ("DracoPy",),
    "lod": ("meshoptimizer",),
    "rays": ("embreex",),
    "mp4": ("imageio-ffmpeg",),
    "batch": ("distributed", "fsspec", "pyarrow"),
    "measure": ("flip-evaluator",),
}


def add(doctor: argparse.ArgumentParser) -> None:
    doctor.set_defaults(command=run)
    doctor.description = (
        "Print the versions of facerender, Python and the system, the OpenGL driver of\n"
        "each backend, the packages of each extra, and the cache. A remedy is printed for\n"
        "each missing part. Exit status: 0 an OpenGL backend works, 2 none works."
    )
    add_options(doctor, "--json | print everything except the cache as JSON")


def run(options: argparse.Namespace) -> int:
    findings = probe()
    usable = [finding["backend"] for finding in findings if not finding["error"]]
    report: dict[str, Any] = {
        "facerender": __version__,
        "python": platform.python_version(),
        "system": _system(),
        "backends": findings,
        "auto": next((name for name in AUTO if name in usable), None),
        "packages": {
            extra: {name: _version_of(name) for name in names} for extra, names in PACKAGES.items()
        },
    }
    if options.json:
        print_result(json.dumps(report, indent=2))
    else:
        print_result(*_lines(report))
    return 0 if usable else 2


def _lines(report: dict[str, Any]) -> list[str]:
    lines = [f"facerender {report['facerender']}, Python {report['python']}, {report['system']}"]
    driver = "{renderer}, OpenGL {version}, up to {samples} samples and {size} pixels per side"
    for finding in report["backends"]:
        lines.append(f"{finding['backend']:7} {finding['error'] or driver.format(**finding)}")
    lines.append(f"auto    {report['auto'] or 'no backend works'}")
    for extra, versions in report["packages"].items():
        words = [f"{name} {version or 'is missing'}" for name, version in versions.items()]
        remedy = "" if all(versions.values()) else f": pip install 'facerender[{extra}]'"
        lines.append(f"{extra or 'Python':7} {', '.join(words)}{remedy}")
    used, limit = cache.size() >> 20, cache.limit() >> 20
    return [*lines, f"cache   {cache.folder()}, {used} of at most {limit} MiB"]


def _system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        return f"{platform.system()} {platform.release()}"


def _version_of(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
