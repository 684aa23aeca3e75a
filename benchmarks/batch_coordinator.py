"""Measure time and memory of the coordinator of a batch.

Measures 10^6 jobs without rendering, and the second run of a finished batch.

    python benchmarks/batch_coordinator.py [--jobs 1000000] [--done 10000]
        [--formats toml csv jsonl]

A substitute engine reports each chunk as done without rendering it. For the finished batch it
writes files of a few bytes with the writer that real workers use.
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
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from facerender.batch import supervisor
from facerender.batch.jobs import Chunk, Settings
from facerender.batch.records import Storage, Writer, begin, commit
from facerender.batch.supervisor import Outcome
from facerender.commands import main as facerender

_FACTS = {
    "facerender": "0", "GL_RENDERER": "none", "GL_VERSION": "none",
    "camera": {"width": 256, "height": 256, "K": [[0.1234567890123456] * 3] * 3,
               "Rt": [[0.1234567890123456] * 4] * 3,
               "transform_matrix": [[0.1234567890123456] * 4] * 4},
}  # fmt: skip


class Nothing(Executor):
    """An executor that reports each chunk as done at once."""

    def submit(self, _: Any, settings: Settings, chunk: Chunk, *rest: Any) -> Future[Any]:  # type: ignore[override]
        """Return a finished future with the outcome that a supervisor would report."""
        future: Future[Outcome] = Future()
        future.set_result(self.answer(settings, chunk))
        return future

    def answer(self, settings: Settings, chunk: Chunk) -> Outcome:
        """Return the outcome of a chunk."""
        return Outcome(chunk.number, Counter(done=len(chunk.rows)), worker="none")


class Small(Nothing):
    """An executor that writes and commits a few bytes for each job."""

    def answer(self, settings: Settings, chunk: Chunk) -> Outcome:
        begin(settings, chunk)
        shards = settings.layout == "shards"
        with Storage(settings.output).temporary() if shards else nullcontext() as tar:
            writer = Writer(settings, chunk, tar, 0)
            records = [
                writer.write(i, {"image.png": b"nothing"}, {"job": row.tables, **_FACTS})
                for i, row in enumerate(chunk.rows)
            ]
            commit(settings, chunk, tar, records)
        return super().answer(settings, chunk)


def write_jobs(path: Path, jobs: int) -> None:
    """Write a table of jobs that orbit the built-in head."""
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
    """Run ``facerender batch`` in this process; print exit status, seconds and peak MiB as JSON."""
    if how != "real":
        executor = {"nothing": Nothing, "small": Small}[how]()

        @contextmanager
        def local(workers: int) -> Iterator[supervisor.Engine]:
            yield supervisor.Engine(executor, lambda: workers, workers)

        supervisor.local = local
    began = time.perf_counter()
    status = facerender(["batch", *words])
    seconds = time.perf_counter() - began
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"status": status, "seconds": seconds, "MiB": most}))


def measured(name: str, how: str, *words: str) -> None:
    """Measure a command in a separate process, and print the result."""
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
            measured(f"{options.jobs} jobs of .{kind}, not rendered", "nothing", str(path),
                     "-o", f"{folder}/{kind}", "--workers", "2")  # fmt: skip
        path = Path(folder, "done.toml")
        write_jobs(path, options.done)
        for layout in ("files", "shards") if options.done else ():
            words = [str(path), "-o", f"{folder}/{layout}", "--workers", "2", "--layout", layout]
            measured(f"{options.done} jobs of {layout}, written", "small", *words)
            measured(f"{options.done} jobs of {layout}, finished before", "real", *words)
            measured(f"--status of {layout}", "real", "--status", f"{folder}/{layout}")


if __name__ == "__main__":
    main()
