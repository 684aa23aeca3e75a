"""Check that a batch loses, repeats and changes no job when its processes are killed at random.

    python benchmarks/batch_kills.py [--kills 100] [--jobs 2000] [--layout shards] [--dask]
                                     [--seed 1] [--edits 0] [--stops 0]

Renders a small mesh once without kills, and once while one process after the other gets SIGKILL.
The targets are the coordinator and its workers; with --dask also the scheduler, the Dask workers,
their nannies and the rendering processes. A killed process is restarted with the same command, as
a user would do. In the end, every file, table and record must exist once and equal the run without
kills byte for byte; otherwise the exit status is 1. --edits N changes the table of jobs N times
during the run; the last edit restores it. --stops N precedes N of the kills by SIGSTOP.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random

import numpy as np
import psutil
from PIL import Image

_DRAWS = "facerender.batch.worker"
_TIMEOUT = 20  # seconds without output before a stopped worker counts as hung
_PATIENCE = 600.0  # seconds without progress before this script gives up
_WORKERS = 2


def small(folder: Path) -> Path:
    """Write a mesh that loads fast, a tetrahedron with an albedo map, and return its path."""
    positions = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "f 1/1 3/3 2/2\nf 1/1 2/2 4/3\nf 1/1 4/3 3/2\nf 2/1 3/2 4/3\n"
    path = folder / "small.obj"
    path.write_text(f"mtllib small.mtl\n{positions}usemtl skin\n{faces}")
    (folder / "small.mtl").write_text("newmtl skin\nmap_Kd -clamp on skin.png\n")
    Image.fromarray(np.full((4, 4, 3), (200, 150, 120), np.uint8)).save(folder / "skin.png")
    return path


def write_table(path: Path, mesh: Path, jobs: int, edit: int = 0) -> None:
    """Write the table of jobs.

    An edit other than 0 omits a tenth of the jobs and changes the material of another tenth.
    """
    lines = []
    for i in range(jobs):
        row = {"id": f"job{i:05d}", "mesh": str(mesh), "camera.azimuth": round(0.01 * i, 3)}
        row |= {"image.size": 48, "image.samples": 1}
        if edit and (i + edit) % 10 == 0:
            continue
        if edit and (i + edit) % 10 == 1:
            row["material.m"] = 0.2 + 0.01 * edit
        lines.append(json.dumps(row) + "\n")
    path.with_suffix(".new").write_text("".join(lines))
    path.with_suffix(".new").replace(path)


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 digests of a batch's files by name.

    Excludes batch.json and .lock, which depend on the place and process of the run.
    """
    files = [path for path in folder.rglob("*") if path.is_file()]
    names = {str(path.relative_to(folder)): path for path in files}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in names.items()
        if name not in ("batch.json", ".lock")
    }


class Cluster:
    """A Dask scheduler and two workers, each restarted after it ends; empty unless ``used``."""

    def __init__(self, used: bool, logs: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        dask = [sys.executable, "-m", "dask"]
        worker = [*dask, "worker", self.address, "--nthreads", "1", "--no-dashboard"]
        worker += ["--local-directory", str(logs)]
        self._commands = {
            "scheduler": [*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port)]
            + ["--no-dashboard"],
            **{f"worker {i}": worker for i in range(_WORKERS)},
        }
        self._logs = logs
        self.running: dict[str, psutil.Popen] = {}
        self.used = used

    def start(self) -> None:
        """Start each process that is not running."""
        for name, command in self._commands.items() if self.used else ():
            if name not in self.running or self.running[name].poll() is not None:
                log = (self._logs / f"{name}.log").open("ab")
                self.running[name] = psutil.Popen(command, stdout=log, stderr=log)

    def stop(self) -> None:
        """Kill all processes and their children."""
        processes = [*self.running.values()]
        for process in list(processes):
            with suppress(psutil.NoSuchProcess):
                processes += process.children(recursive=True)
        for process in processes:
            with suppress(psutil.NoSuchProcess):
                process.kill()
                process.wait(10)


def living(coordinator: psutil.Popen, cluster: Cluster) -> dict[str, list[psutil.Process]]:
    """Return the running processes of a batch by their role."""
    found: dict[str, list[psutil.Process]] = {"coordinator": [coordinator]}
    for name, process in cluster.running.items():
        found.setdefault("scheduler" if name == "scheduler" else "nanny", []).append(process)
    for parent in (coordinator, *cluster.running.values()):
        with suppress(psutil.NoSuchProcess):
            for child in parent.children(recursive=True):
                with suppress(psutil.NoSuchProcess):
                    words = " ".join(child.cmdline())
                    if _DRAWS in words:
                        found.setdefault("drawing", []).append(child)
                    elif parent is not coordinator and "spawn_main" in words:
                        found.setdefault("Dask worker", []).append(child)
    return found


def killed(
    command: list[str],
    out: Path,
    cluster: Cluster,
    options: argparse.Namespace,
    edit: Callable[[int], None],
) -> tuple[Counter[str], Counter[str], float]:
    """Run a batch to its end while its processes are killed; call ``edit`` --edits times.

    Returns the number of kills by role, the exit statuses of coordinators, and the seconds.
    """
    random = Random(options.seed)
    who, ends = Counter[str](), Counter[str]()
    began = moved = time.monotonic()
    log = (out.parent / f"{out.name}.log").open("ab")
    cluster.start()
    coordinator = psutil.Popen(command, stdout=log, stderr=log)
    kills = edits = seen = 0
    stops = set(random.sample(range(options.kills), options.stops))
    chunks = -(-options.jobs // options.chunk)
    kinds = ["coordinator", "drawing", "drawing"]
    kinds += ["scheduler", "nanny", "Dask worker"] if options.dask else []
    wanted = random.choice(kinds)
    while True:
        time.sleep(0.01)
        records = len(list(out.glob("records/*.jsonl")))
        if records != seen:
            seen, moved = records, time.monotonic()
        if time.monotonic() - moved > _PATIENCE:
            raise SystemExit(f"no progress for {_PATIENCE:g} s at {records} records")
        cluster.start()
        if (code := coordinator.poll()) is not None:
            ends[str(code)] += 1
            if code == 0 and kills >= options.kills and edits >= options.edits:
                return who, ends, time.monotonic() - began
            if edits < options.edits and (code == 0 or random.random() < 0.3):
                edits += 1
                edit(edits % options.edits)
            elif code == 0:  # finished before the last kill: start over for the remaining kills
                shutil.rmtree(out / "records")
                (out / "jobs.jsonl").unlink()
                ends["started over"] += 1
            coordinator = psutil.Popen(command, stdout=log, stderr=log)
            continue
        # Spread the kills over the whole batch, including its start and its end.
        if kills >= options.kills or records < chunks * (kills - 3) / options.kills:
            continue
        found = living(coordinator, cluster)
        if wanted not in found:
            continue  # this role has not started yet
        time.sleep(random.choice((0.0, random.uniform(0.0, 0.3), random.uniform(0.0, 3.0))))
        kind, wanted = wanted, random.choice(kinds)
        victim = random.choice(found[kind])
        with suppress(psutil.NoSuchProcess):
            if kills in stops:
                victim.suspend()
                time.sleep(random.uniform(0.5, 1.5 * _TIMEOUT))
                if random.random() < 0.5:
                    victim.send_signal(signal.SIGCONT)
                    who[f"{kind}, stopped"] += 1
                    kills += 1
                    continue
            victim.kill()
            if victim is coordinator:
                coordinator.wait()
            kills += 1
            moved = time.monotonic()
            who[kind] += 1


def faults(expected: dict[str, str], got: dict[str, str], out: Path) -> list[str]:
    """Return a line for each file that is missing, unexpected or different, or repeated job."""
    found = [f"missing: {name}" for name in sorted(expected.keys() - got.keys())]
    found += [f"unexpected: {name}" for name in sorted(got.keys() - expected.keys())]
    found += [f"different: {name}" for name in sorted(expected) if got.get(name, "") not in
              ("", expected[name])]  # fmt: skip
    lines = (out / "jobs.jsonl").read_text().splitlines()
    ids = Counter(json.loads(line)["id"] for line in lines)
    return found + [f"{count} times: {name}" for name, count in ids.items() if count > 1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2000)
    parser.add_argument("--chunk", type=int, default=8)
    parser.add_argument("--layout", choices=("files", "shards"), default="files")
    parser.add_argument("--dask", action="store_true", help="use a local Dask cluster")
    parser.add_argument("--edits", type=int, default=0, help="edits of the table of jobs")
    parser.add_argument("--stops", type=int, default=0, help="kills that follow a SIGSTOP")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="batch-kills-"))
    mesh, table = small(folder), folder / "jobs.jsonl"
    write_table(table, mesh, options.jobs)
    command = [sys.executable, "-m", "facerender", "batch", str(table), "--layout", options.layout]
    command += ["--chunk", str(options.chunk), "--workers", str(_WORKERS)]
    calm, out = folder / "calm", folder / "killed"
    began = time.monotonic()
    subprocess.run([*command, "-o", str(calm)], check=True, capture_output=True)
    alone = time.monotonic() - began
    cluster = Cluster(options.dask, folder)
    if options.dask:
        command += ["--scheduler", cluster.address]
    command += ["-o", str(out), "--timeout", str(_TIMEOUT), "--json"]
    command += ["--prune"] * bool(options.edits)
    try:
        who, ends, seconds = killed(
            command, out, cluster, options, lambda at: write_table(table, mesh, options.jobs, at)
        )
    finally:
        cluster.stop()
    expected, got = digests(calm), digests(out)
    wrong = faults(expected, got, out)
    events = [json.loads(line) for line in (folder / "killed.log").read_text().splitlines()
              if line.startswith("{")]  # fmt: skip
    drawn = sum(each.get("drawn", 0) for each in events if each["event"] == "chunk")
    print(f"{options.jobs} jobs, {options.layout}, {'Dask' if options.dask else 'local'}, seed "
          f"{options.seed}: {alone:.0f} s without kills, {seconds:.0f} s with")  # fmt: skip
    for name, count in who.most_common():
        print(f"  {count:4} kills: {name}")
    print(f"  exit statuses of coordinators: {dict(ends)}; {drawn} jobs in reported chunks")
    print(f"  {len(got)} files, {len(expected)} expected: {len(wrong)} errors")
    for fault in wrong[:20]:
        print(f"  {fault}")
    if wrong:
        print(f"  see {folder}")
    else:
        shutil.rmtree(folder)
    return bool(wrong)


if __name__ == "__main__":
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path[1:]))
    raise SystemExit(main())
