"""Feeds changed files to every reader, and counts what comes of them.

    python -m tests.verification.fuzz [--minutes 10 | --inputs N] [--seed S]
        [--only NAME] [-o out/fuzz]

A process for each core; Atheris chooses by coverage what is changed again. Of every kind of fault
the first input is written to the folder, and what was seen beside it, as .txt. Exit status 1 where
there is a fault.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

from tests.verification.fuzz.worker import Share


def main() -> int:
    parser = argparse.ArgumentParser(
        "python -m tests.verification.fuzz", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--inputs", type=int, help="how many, in place of minutes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="subjects with this in their name")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/fuzz"))
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for old in options.output.iterdir():
        old.unlink()
    start = time.monotonic()
    count = os.cpu_count() or 1
    shares = [
        Share(
            str(options.output),
            f"{options.seed}-{number}",
            options.inputs and -(-options.inputs // count),
            time.time() + 60.0 * options.minutes,
            options.only,
        )
        for number in range(count)
    ]
    running = {share: _begin(share) for share in shares}
    deaths = 0
    while running:
        time.sleep(1.0)
        for share, process in list(running.items()):
            if process.poll() is None:
                continue
            if process.returncode and not share.done:
                deaths += 1
                running[share] = _begin(share)
            else:
                del running[share]
    counts = sum((share.counts for share in shares), Counter[str]())
    seconds = time.monotonic() - start
    print(f"{counts.total()} inputs in {seconds:.0f} s: {dict(counts)}, {deaths} processes ended")
    faults = {path.read_text(): path for path in sorted(options.output.glob("*.txt"))}
    for seen, path in faults.items():
        print(f"{path.stem}: {seen.strip()}")
    return 1 if faults or deaths else 0


def _begin(share: Share) -> subprocess.Popen[bytes]:
    program = f"from tests.verification.fuzz.worker import *; work({share!r})"
    with (Path(share.output) / f"{share.name}.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-c", program],
            env=os.environ | {"LP_NUM_THREADS": "1"},
            stdout=log,
            stderr=log,
        )


if __name__ == "__main__":
    sys.exit(main())
