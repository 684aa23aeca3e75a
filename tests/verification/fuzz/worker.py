"""A process of the fuzzer: examines what Atheris and our own mutations make, counts outcomes, and
writes inputs that show a fault."""

from __future__ import annotations

import hashlib
import logging
import os
import resource
import shutil
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

import numpy as np

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
    def tally(self) -> np.memmap[tuple[int], np.dtype[np.int64]]:
        """How often each outcome was seen, in a file: it outlives the process."""
        from tests.verification.fuzz.subjects import OUTCOMES

        path = Path(self.output, f"{self.name}.counts")
        return np.memmap(path, np.int64, "r+" if path.exists() else "w+", shape=len(OUTCOMES))

    @property
    def counts(self) -> Counter[str]:
        from tests.verification.fuzz.subjects import OUTCOMES

        return Counter(dict(zip(OUTCOMES, self.tally.tolist(), strict=True)))

    @property
    def done(self) -> bool:
        if self.inputs is None:
            return time.time() >= self.until
        return int(self.tally.sum()) >= self.inputs


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
    tally = share.tally
    # After a death the same random numbers would lead to it again.
    random = Random(f"{share.name}-{tally.sum()}")
    known: set[str] = set()
    with tempfile.TemporaryDirectory(dir=SHARED if SHARED.exists() else None) as folder:
        place, corpus = Path(folder, "input"), Path(folder, "corpus")
        corpus.mkdir()
        for number, subject in enumerate(chosen):
            (corpus / str(number)).write_bytes(bytes([number]) + subject.seed)

        def one(data: bytes) -> None:
            subject = chosen[data[0] % len(chosen)] if data else chosen[0]
            result = examine(subject, data[1:], place)
            tally[OUTCOMES.index(result.outcome)] += 1
            if result.outcome in FAULTS and result.signature not in known:
                known.add(result.signature)
                _keep(
                    Path(share.output),
                    subject.name,
                    subject.suffix,
                    data[1:],
                    f"{result.outcome}: {result.signature}",
                )
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


def _keep(output: Path, subject: str, suffix: str, content: bytes, seen: str) -> None:
    name = f"{subject}-{hashlib.sha256(content).hexdigest()[:8]}"
    (output / f"{name}{suffix}").write_bytes(content)
    (output / f"{name}.txt").write_text(seen + "\n")
