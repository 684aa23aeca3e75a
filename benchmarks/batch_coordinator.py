"""Cost of a batch for its coordinator: time and memory of 10^6 jobs, of which none is drawn, and of
a second run of a batch that is done.

    python benchmarks/batch_coordinator.py [--jobs 1000000] [--done 10000]
        [--formats toml csv jsonl]

Chunks go to an engine that takes and answers them without drawing. Of the batch that is done, the
files are written by what workers write with, and are a few bytes each.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from facerender.batch import engine
from facerender.batch.chunk import Chunk, Settings
from facerender.batch.records import Writer, begin, commit
from facerender.batch.storage import Storage
from facerender.batch.supervisor import Outcome
from facerender.commands import main as facerender

_FACTS = {
    "facerender": "0", "GL_RENDERER": "none", "GL_VERSION": "none",
    "camera": {"width": 256, "height": 256, "K": [[0.1234567890123456] * 3] * 3,
               "Rt": [[0.1234567890123456] * 4] * 3,
               "transform_matrix": [[0.1234567890123456] * 4] * 4},
}  # fmt: skip


class Nothing(Executor):
    """Answers chunks at once."""

    def submit(self, _: Any, settings: Settings, chunk: Chunk, *heard: Any) -> Future[Any]:  # type: ignore[override]
        """As a supervisor would, of what it does not draw."""
        future: Future[Outcome] = Future()
        future.set_result(self.answer(settings, chunk))
        return future

    def answer(self, settings: Settings, chunk: Chunk) -> Outcome:
        """What became of a chunk."""
        return Outcome(chunk.number, len(chunk.rows), 0, (), 0.0, 0, "", "none")


class Small(Nothing):
    """Writes and commits a few bytes for each job."""

    def answer(self, settings: Settings, chunk: Chunk) -> Outcome:
        begin(settings, chunk)
        tar = Storage(settings.output).unfinished() if settings.layout == "shards" else None
        writer = Writer(settings, chunk, tar, 0)
        records = [
            writer.write(i, {"image.png": b"nothing"}, {"job": row.tables, **_FACTS})
            for i, row in enumerate(chunk.rows)
        ]
        commit(settings, chunk, tar, records)
        return super().answer(settings, chunk)


def write_jobs(path: Path, jobs: int) -> None:
    """Write a table of turns about the built-in head."""
    if path.suffix == ".toml":
        path.write_text(
            'id = "v{number:08d}"\n[image]\nsize = 256\nsamples = 4\n[grid]\n'
            f'"camera.azimuth" = {{ from = -60, to = 60, count = {jobs // 10} }}\n'
            '"material.m" = { from = 0.1, to = 0.4, count = 10 }\n'
        )
        return
    with path.open("w") as file:
        if path.suffix == ".csv":
            file.write("id,camera.azimuth,material.m,image.size\n")
        for i in range(jobs):
            azimuth, m = round(120 * i / jobs - 60, 6), round(0.1 + 0.3 * i / jobs, 6)
            row = {"id": f"v{i:08d}", "camera.azimuth": azimuth, "material.m": m}
            row["image.size"] = 256
            words = map(str, row.values())
            file.write((",".join(words) if path.suffix == ".csv" else json.dumps(row)) + "\n")


def run(how: str, words: list[str]) -> None:
    """Run a command, and print its seconds and MiB; the process of one measurement."""
    if how != "real":
        executor = {"nothing": Nothing, "small": Small}[how]()

        @contextmanager
        def local(workers: int) -> Iterator[engine.Engine]:
            yield engine.Engine(executor, lambda: workers, workers)

        engine.local = local
    began = time.perf_counter()
    status = facerender(["batch", *words])
    seconds = time.perf_counter() - began
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"status": status, "seconds": seconds, "MiB": most}))


def measured(name: str, how: str, *words: str) -> None:
    """Measure a command in a process of its own."""
    command = [sys.executable, __file__, "--run", how, "--", *words]
    began = time.perf_counter()
    found = subprocess.run(command, capture_output=True, text=True)
    whole = time.perf_counter() - began
    if found.returncode:
        raise SystemExit(found.stderr)
    last = json.loads(found.stdout.splitlines()[-1])
    print(
        f"{name:44} {whole:7.1f} s {last['MiB']:6.0f} MiB  exit status {last['status']}", flush=True
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=10**6)
    parser.add_argument("--done", type=int, default=10**4)
    parser.add_argument("--formats", nargs="*", default=["toml", "csv", "jsonl"])
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parser.add_argument("words", nargs="*", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run(options.run, options.words)
        return
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path[1:]))
    with tempfile.TemporaryDirectory() as folder:
        for kind in options.formats:
            path = Path(folder, f"jobs.{kind}")
            write_jobs(path, options.jobs)
            measured(f"{options.jobs} jobs of .{kind}, none drawn", "nothing", str(path),
                     "-o", f"{folder}/{kind}", "--workers", "2")  # fmt: skip
        path = Path(folder, "done.toml")
        write_jobs(path, options.done)
        for layout in ("files", "shards") if options.done else ():
            words = [str(path), "-o", f"{folder}/{layout}", "--workers", "2", "--layout", layout]
            measured(f"{options.done} jobs of {layout}, written", "small", *words)
            measured(f"{options.done} jobs of {layout}, done before", "real", *words)
            measured(f"--status of {layout}", "real", "--status", f"{folder}/{layout}")


if __name__ == "__main__":
    main()
