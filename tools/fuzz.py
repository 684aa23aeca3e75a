"""Feeds changed files to every reader, and counts what comes of them.

    python -m tools.fuzz [--minutes 10 | --inputs N] [--seed S] [--only NAME] [-o out/fuzz]

A process for each core examines what Atheris, which chooses by coverage what is changed again, and
tests/verification/fuzz make. Of every kind of fault the first input is written to the folder, and
what was seen beside it, as .txt. Exit status 1 where there is a fault.
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

HANGS = 300  # seconds, after which an input ends its process; a busy machine may stop it for 60
SPACE = 16 << 30  # bytes of addresses: an allocation beyond them fails
LONGEST = 1 << 16  # bytes of an input
# What Atheris follows: our modules, and what parses for us.
FOLLOWED = ("facerender", "trimesh", "PIL", "tomllib")
SHARED = Path("/dev/shm")


@dataclass(frozen=True)
class Share:
    """What a process is to do.

    Attributes
    ----------
    output : folder of faults, counts and logs
    name : of its files, and what its random numbers come from
    inputs : how many, or None
    until : seconds since the epoch, that count where inputs is None
    only : what the names of subjects contain
    """

    output: str
    name: str
    inputs: int | None
    until: float
    only: str

    @property
    def seen(self) -> Path:
        """The outcomes, a byte each, in a file: it outlives the process."""
        return Path(self.output, f"{self.name}.seen")

    @property
    def count(self) -> int:
        return self.seen.stat().st_size if self.seen.exists() else 0

    @property
    def done(self) -> bool:
        return time.time() >= self.until if self.inputs is None else self.count >= self.inputs


def following() -> AbstractContextManager[object]:
    """Let Atheris follow what is imported meanwhile: its branches. What comparisons compare would
    serve libFuzzer's own mutations, and Atheris 3.0 never frees a comparison's result, such as an
    array of a million truth values."""
    from atheris.import_hook import HookManager

    hook: AbstractContextManager[object]
    hook = HookManager(set(FOLLOWED), set(), enable_loader_override=True, trace_dataflow=False)
    return hook


def work(share: Share) -> NoReturn:
    """Examine inputs until the share is done; a process that ends before has met a fault that ends
    processes."""
    import atheris

    with following():
        from PIL import Image

        from facerender.scenes import framing
        from tests.verification.fuzz.mutate import mutate
        from tests.verification.fuzz.subjects import FAULTS, OUTCOMES, examine, subjects

        # What is imported where it is needed otherwise.
        Image.init()
        for parser in ("trimesh.exchange.load", "trimesh.visual", "tomllib"):
            import_module(parser)
    # Of points on the surface of a few triangles, which took most of the time.
    framing._SAMPLES //= 100
    logging.disable()
    resource.setrlimit(resource.RLIMIT_AS, (SPACE, SPACE))
    chosen = [each for each in subjects() if share.only in each.name]
    # After a death the same random numbers would lead to it again.
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
                seen = f"{result.outcome}: {result.signature}\n"
                Path(share.output, f"{name}.txt").write_text(seen)
            if share.done:
                shutil.rmtree(folder)
                os._exit(0)  # what ends Python is a crash to Atheris

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
    seen = b"".join(share.seen.read_bytes() for share in shares if share.count)
    counts = Counter(OUTCOMES[each] for each in seen)
    seconds = time.monotonic() - start
    print(f"{counts.total()} inputs in {seconds:.0f} s: {dict(counts)}, {deaths} processes ended")
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
