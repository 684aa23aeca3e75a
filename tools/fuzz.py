"""Fuzz every file reader with mutated files, guided by coverage.

    python -m tools.fuzz [--minutes 10 | --inputs N] [--seed S] [--only NAME] [-o out/fuzz]

Each core runs a process. Atheris selects inputs by coverage, tests/verification/fuzz mutates them
and calls the reader. The first input of each kind of error is written to the output folder, with a
description as .txt. The exit status is 1 if there is an error.
"""

from __future__ import annotations

import argparse
import hashlib
import logging
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import AbstractContextManager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from random import Random
from typing import NoReturn

HANGS = 300  # seconds per input before the process ends; a busy machine may pause it for 60
SPACE = 16 << 30  # limit of the address space in bytes: larger allocations fail
LONGEST = 1 << 16  # maximum bytes of an input
# Packages whose coverage Atheris records: facerender and its parsers.
FOLLOWED = ("facerender", "trimesh", "PIL", "tomllib")
SHARED = Path("/dev/shm")


@dataclass(frozen=True)
class Share:
    """The work of one process.

    Attributes
    ----------
    output : folder of errors, counts and logs
    name : name of its files, and seed of its random numbers
    inputs : number of inputs, or None
    until : end in seconds since the epoch; used if ``inputs`` is None
    only : text that the names of subjects must contain
    """

    output: str
    name: str
    inputs: int | None
    until: float
    only: str

    @property
    def seen(self) -> Path:
        """File of outcomes, one byte each; it survives a crash of the process."""
        return Path(self.output, f"{self.name}.seen")

    @property
    def count(self) -> int:
        return self.seen.stat().st_size if self.seen.exists() else 0

    @property
    def done(self) -> bool:
        return time.time() >= self.until if self.inputs is None else self.count >= self.inputs


def following() -> AbstractContextManager[object]:
    """Return a context in which Atheris instruments the branches of imported modules.

    Comparisons are not traced. They would only guide libFuzzer's own mutations, and Atheris 3.0
    never frees the result of a comparison, such as an array of a million booleans.
    """
    from atheris.import_hook import HookManager

    hook: AbstractContextManager[object]
    hook = HookManager(set(FOLLOWED), set(), enable_loader_override=True, trace_dataflow=False)
    return hook


def work(share: Share) -> NoReturn:
    """Examine inputs until the share is done; a process that ends earlier has crashed."""
    import atheris

    with following():
        from PIL import Image

        from tests.verification.fuzz.mutate import mutate
        from tests.verification.fuzz.subjects import FAULTS, OUTCOMES, REDUCED, examine, subjects

        # Modules that are normally imported lazily.
        Image.init()
        for parser in ("trimesh.exchange.load", "trimesh.visual", "tomllib"):
            import_module(parser)
    for module, name, value in REDUCED:
        setattr(module, name, value)
    logging.disable()
    resource.setrlimit(resource.RLIMIT_AS, (SPACE, SPACE))
    chosen = [each for each in subjects() if share.only in each.name]
    # Change the seed after a crash: the same random numbers would cause the same crash.
    random = Random(f"{share.name}-{share.count}")
    known: set[str] = set()
    with tempfile.TemporaryDirectory(dir=SHARED if SHARED.exists() else None) as folder:
        place, corpus = Path(folder, "input"), Path(folder, "corpus")
        corpus.mkdir()
        for number, subject in enumerate(chosen):
            (corpus / str(number)).write_bytes(bytes([number]) + subject.seed)

        def one(data: bytes) -> None:
            subject = chosen[data[0] % len(chosen)] if data else chosen[0]
            result = examine(subject, data[1:], place)
            with share.seen.open("ab") as file:
                file.write(bytes([OUTCOMES.index(result.outcome)]))
            if result.outcome in FAULTS and result.signature not in known:
                known.add(result.signature)
                name = f"{subject.name}-{hashlib.sha256(data[1:]).hexdigest()[:8]}"
                Path(share.output, f"{name}{subject.suffix}").write_bytes(data[1:])
                description = f"{result.outcome}: {result.signature}\n"
                Path(share.output, f"{name}.txt").write_text(description)
            if share.done:
                shutil.rmtree(folder)
                os._exit(0)  # Atheris would report a normal exit as a crash

        def changed(data: bytes, longest: int, seed: int) -> bytes:
            subject = chosen[data[0] % len(chosen)] if data else chosen[0]
            content = mutate(data[1:] or subject.seed, subject.suffix, Random(seed))
            return (data[:1] + content)[:longest]

        settings = {
            "seed": random.randrange(1, 2**31),
            "timeout": HANGS,
            "max_len": LONGEST,
            "len_control": 0,
            "rss_limit_mb": 0,
            "detect_leaks": 0,
            "verbosity": 0,
            "artifact_prefix": f"{share.output}/{share.name}-",
        }
        flags = [f"-{name}={value}" for name, value in settings.items()]
        atheris.Setup([sys.argv[0], *flags, str(corpus)], one, custom_mutator=changed)
        atheris.Fuzz()
    sys.exit(0)


def main() -> int:
    from tests.verification.fuzz.subjects import OUTCOMES

    parser = argparse.ArgumentParser(
        prog="python -m tools.fuzz", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--inputs", type=int, help="number of inputs; overrides --minutes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the names of subjects")
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
    seen = b"".join(share.seen.read_bytes() for share in shares if share.count)
    counts = Counter(OUTCOMES[each] for each in seen)
    seconds = time.monotonic() - start
    print(f"{counts.total()} inputs in {seconds:.0f} s: {dict(counts)}, {deaths} processes crashed")
    faults = {path.read_text(): path for path in sorted(options.output.glob("*.txt"))}
    for seen, path in faults.items():
        print(f"{path.stem}: {seen.strip()}")
    return 1 if faults or deaths else 0


def _begin(share: Share) -> subprocess.Popen[bytes]:
    program = f"from tools.fuzz import *; work({share!r})"
    with (Path(share.output) / f"{share.name}.log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-c", program],
            env=os.environ | {"LP_NUM_THREADS": "1"},
            stdout=log,
            stderr=log,
        )


if __name__ == "__main__":
    sys.exit(main())
