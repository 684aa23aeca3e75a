"""Measure the parameters of benchmarks/scale.py on this machine.

    python benchmarks/scale_measure.py [draw coordinator scheduler store ...]    default: all

Writes docs/measurements/scale.json.

draw         `facerender batch` to shards of image, mask and 16-bit depth at 256 pixels: CPU time
             per job of all processes without their start; bytes; CPU time to load a mesh
coordinator  `facerender batch --check`: CPU time per row; bytes of a pickled chunk of rows
scheduler    `dask scheduler` and `dask worker` on loopback, with sleeping tasks that carry the rows
             of a chunk: CPU time of scheduler and coordinator per task, round trips, maximum rate
store        10^4 small files, and shards of 100 of them, to a folder and to moto's S3 on loopback
             through s3fs
"""

from __future__ import annotations

import argparse
import io
import json
import os
import pickle
import resource
import socket
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parent
MEASURED = ROOT / "docs" / "measurements" / "scale.json"
BIN = Path(sys.executable).parent
SIZE, JOBS = 256, 100  # width and height of an image, jobs per chunk
TICK = os.sysconf("SC_CLK_TCK")


def row(index: int) -> dict[str, Any]:
    """Return a typical job for training data: a camera, a material, two lights."""
    lights = [
        {"azimuth": index * 0.37 % 180.0, "elevation": 35.0, "irradiance": 3.0},
        {"azimuth": index * 0.11 % 180.0, "elevation": -20.0, "irradiance": 1.0},
    ]
    camera = {"azimuth": index * 37.0 % 140.0 - 70.0, "elevation": index * 23.0 % 40.0 - 20.0}
    return {"id": f"{index:08d}", "camera": camera, "material": {"m": 0.3}, "lights": lights}


def batch_cpu_s(folder: str, count: int, *options: str) -> float:
    """Return the CPU seconds of `facerender batch` with its workers for a table of N rows."""
    table = Path(folder, f"{count}.jsonl")
    table.write_text("".join(json.dumps(row(index)) + "\n" for index in range(count)))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "facerender", "batch", str(table), *options]
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def draw() -> dict[str, Any]:
    """Measure the time per image as the difference of a longer and a shorter batch."""
    from facerender import MeshFile
    from facerender.system.files import data_dir
    from tests.verification.cache import wait_for_cache

    head = MeshFile(str(data_dir("assets") / "head.glb"))
    head.load(cache=True)
    wait_for_cache()
    start = time.process_time()
    head.load(cache=True)
    loaded = time.process_time() - start
    options = ("--size", str(SIZE), "--outputs", "image,mask,depth", "--layout", "shards")
    few, many = 50, 250
    with tempfile.TemporaryDirectory() as folder:
        cpu = {
            count: batch_cpu_s(folder, count, *options, "--chunk", "25", "-o", f"{folder}/{count}")
            for count in (few, many)
        }
        out = Path(folder, str(many))
        records = [
            json.loads(line)
            for path in sorted((out / "records").iterdir())
            for line in path.read_text().splitlines()[1:]
        ]
        sizes = {
            name: sum(path.stat().st_size for path in out.glob(pattern)) / many
            for name, pattern in (
                ("shard", "shards/*"),
                ("record", "records/*"),
                ("table", "*.jsonl"),
            )
        }
    sizes |= {
        name: statistics.mean(record["files"][name]["bytes"] for record in records)
        for name in records[0]["files"]
    }
    image = (cpu[many] - cpu[few]) / (many - few)
    return {
        **{"image_s": image, "start_s": cpu[few] - few * image, "load_s": loaded, "bytes": sizes},
        **{"jobs": [few, many], "size": SIZE, "renderer": records[0]["GL_RENDERER"]},
        "version": records[0]["GL_VERSION"],
    }


def coordinator() -> dict[str, Any]:
    """Measure the time to read and check a row, and the size of a pickled chunk of rows."""
    few, many = 1000, 21000
    with tempfile.TemporaryDirectory() as folder:
        cpu = [batch_cpu_s(folder, count, "--check") for count in (few, many)]
    size = len(pickle.dumps([row(index) for index in range(JOBS)]))
    return {"rows": many, "row_s": (cpu[1] - cpu[0]) / (many - few), "chunk_bytes": size}


def free_port() -> int:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return int(held.getsockname()[1])


@contextmanager
def processes(*commands: list[str]) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run commands in the background, and kill them at the end."""
    paths = {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, HERE)))}  # workers import this module
    running = [
        subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **paths},
        )
        for command in commands
    ]
    try:
        yield running
    finally:
        for process in running:
            process.kill()
            process.wait()


def cpu_s(pid: int) -> float:
    """Return the user and system time of a process in seconds."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def nothing(seconds: float, number: int, jobs: Any) -> dict[str, Any]:
    """Sleep instead of rendering a chunk, and return the result of a finished chunk."""
    time.sleep(seconds)
    return {"chunk": number, "done": len(jobs), "failed": [], "bytes": 0, "seconds": seconds}


def through_dask(slots: int, nap: float, count: int) -> dict[str, Any]:
    """Send chunks through a scheduler to two workers, with three chunks in flight per slot."""
    from dask.distributed import Client, as_completed
    from scale_measure import nothing  # a function of a module is pickled by name

    address = f"tcp://127.0.0.1:{free_port()}"
    port = address.rsplit(":", 1)[1]
    scheduler = [str(BIN / "dask"), "scheduler", "--host", "127.0.0.1", "--port", port]
    worker = [str(BIN / "dask"), "worker", address, "--nthreads", str(slots // 2), "--no-nanny"]
    scheduler, worker = [*scheduler, "--no-dashboard"], [*worker, "--no-dashboard"]
    jobs = [row(index) for index in range(JOBS)]
    with processes(scheduler, worker, worker) as running, Client(address, timeout=60) as client:
        client.wait_for_workers(2, timeout=60)
        trips = []
        for number in range(60):
            start = time.perf_counter()
            client.submit(nothing, 0.0, -1 - number, jobs, pure=False).result()
            trips.append(time.perf_counter() - start)
        before, own = [cpu_s(each.pid) for each in running], time.process_time()
        start = time.perf_counter()
        sent, done = 0, as_completed()
        while sent < min(3 * slots, count) or not done.is_empty():
            if sent >= 3 * slots:
                next(done).result()
            if sent < count:
                done.add(client.submit(nothing, nap, sent, jobs, pure=False, key=f"chunk-{sent}"))
                sent += 1
        seconds = time.perf_counter() - start
        used = [cpu_s(each.pid) - was for each, was in zip(running, before, strict=True)]
        own = time.process_time() - own
    trips.sort()
    return {
        **{"slots": slots, "nap_s": nap, "tasks": count, "offered": slots / nap},
        **{"done": count / seconds, "scheduler_s": used[0] / count, "coordinator_s": own / count},
        **{"workers_s": sum(used[1:]) / count},
        "trip_s": [trips[len(trips) * at // 100] for at in (10, 50, 90)],
    }


def scheduler() -> list[dict[str, Any]]:
    """Measure schedulers with slots that can process 12, 50, 200 and 800 chunks per second."""
    runs = ((24, 2.0, 300), (100, 2.0, 1000), (200, 1.0, 3000), (400, 0.5, 4000))
    return [through_dask(*each) for each in runs]


def shard(content: bytes, files: int) -> bytes:
    held = io.BytesIO()
    with tarfile.open(fileobj=held, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for number in range(files):
            entry = tarfile.TarInfo(f"{number:06d}.png")
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    return held.getvalue()


def timed(names: list[str], content: bytes, put: Callable[[str, bytes], None], at_once: int) -> Any:
    """Return the wall-clock seconds of all requests, and the median and 99th percentile of one."""

    def one(name: str) -> float:
        start = time.perf_counter()
        put(name, content)
        return time.perf_counter() - start

    start = time.perf_counter()
    with ThreadPoolExecutor(at_once) as pool:
        each = sorted(pool.map(one, names))
    return {
        "requests": len(names),
        "at_once": at_once,
        "seconds": time.perf_counter() - start,
        "median_s": each[len(each) // 2],
        "p99_s": each[len(each) * 99 // 100],
    }


def store() -> dict[str, Any]:
    """Measure 10^4 files of 30 kB, and the same as 100 shards, to a folder and to a local S3."""
    import s3fs

    small, count = os.urandom(30000), 10000
    large = shard(small, JOBS)
    files, shards = (
        [f"{n:06d}.png" for n in range(count)],
        [f"{n:06d}.tar" for n in range(count // JOBS)],
    )
    times: dict[str, Any] = {"bytes": len(small)}
    with tempfile.TemporaryDirectory() as folder:

        def to_folder(name: str, content: bytes) -> None:
            path = Path(folder, name)
            held = path.with_suffix(".part")
            held.write_bytes(content)
            held.replace(path)

        times["folder files"] = timed(files, small, to_folder, 1)
        times["folder shards"] = timed(shards, large, to_folder, 1)
        start = time.perf_counter()
        found = len(os.listdir(folder))
        times["folder list"] = {"found": found, "seconds": time.perf_counter() - start}
    port = str(free_port())
    url = f"http://127.0.0.1:{port}"
    with processes([str(BIN / "moto_server"), "-H", "127.0.0.1", "-p", port]):
        for _ in range(120):
            try:
                urllib.request.urlopen(url, timeout=5).close()
                break
            except OSError:
                time.sleep(0.5)
        options = {
            "key": "x",
            "secret": "x",
            "endpoint_url": url,
        }
        system = s3fs.S3FileSystem(**options)
        system.mkdir("batch")
        for at_once in (1, 8):

            def to_s3(name: str, content: bytes, at: str = f"batch/{at_once}") -> None:
                system.pipe_file(f"{at}/{name}", content)

            times[f"s3 files {at_once}"] = timed(files, small, to_s3, at_once)
            times[f"s3 shards {at_once}"] = timed(shards, large, to_s3, at_once)
        start = time.perf_counter()
        found = len(system.find("batch/1"))
        times["s3 list"] = {"found": found, "seconds": time.perf_counter() - start}
    return times


def machine() -> dict[str, Any]:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")
    return {"cores": os.cpu_count(), "processor": name, "date": time.strftime("%Y-%m-%d")}


PARTS = {"draw": draw, "coordinator": coordinator, "scheduler": scheduler, "store": store}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"one of {', '.join(PARTS)}")
    options = parser.parse_args()
    if unknown := set(options.parts).difference(PARTS):
        parser.error(f"unknown part {', '.join(unknown)}: choose from {', '.join(PARTS)}")
    data = json.loads(MEASURED.read_text(encoding="utf-8")) if MEASURED.exists() else {}
    data["machine"] = machine()
    for name in options.parts or PARTS:
        data[name] = PARTS[name]()
        print(name, json.dumps(data[name], indent=1))
        MEASURED.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
