"""Simulate a batch on a cluster: its throughput in images per second, and its bottleneck.

    python -m benchmarks.scale [--workers N] [--chunk N] [--layout shards|files] [--parts N]
        [--set NAME=VALUE ...] [--measured docs/measurements/scale.json] [-o FILE.json]

Without options, prints the tables of docs/measurements/scale.md. With -o, also writes their data
for `python -m tools.docs`: docs/measurements/scale_simulated.json. The simulation of events takes
seconds in one process. Its model:

- Each part of the table has a coordinator, which reads and hashes rows and keeps a window of chunks
  in flight.
- Each part has a scheduler, which serves one message at a time. Half of a task's time is due when
  the task arrives, half when it is done. Times are lognormal.
- A worker renders one chunk at a time. Some workers are slow, children crash, workers are lost. A
  worker that finishes starts the next task of its scheduler at once, because Dask's workers hold a
  task in advance.
- The store serves the requests of a worker one at a time, or ``puts`` at a time, with lognormal
  latencies. A worker continues when its record is stored.
- All requests share a rate limit, and all bytes share a link. Both are fluid queues, which process
  the requests or bytes of a chunk as one unit.

Measured values come from docs/measurements/scale.json, which benchmarks/scale_measure.py writes.
``Cluster`` documents the source of each other value. Equal seeds give equal results.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

import numpy as np

MEASURED = Path(__file__).parents[1] / "docs" / "measurements" / "scale.json"
TARGET = 1e8 / 86400.0  # images per second: 10^8 per day


@dataclass(frozen=True)
class Cluster:
    """The parameters of a simulated cluster, in seconds, bytes and units per second.

    Measured: draw, chunk_start, image_bytes, coordinator_row, coordinator_chunk, scheduler and
    scheduler_sigma. Public: request_limit is Amazon S3's limit of PUTs per second and prefix; put
    is in the middle of S3's stated latencies of small objects ("Best practices design patterns:
    optimizing Amazon S3 performance"). All other values are assumptions.

    Parameters
    ----------
    workers : number of rendering processes
    chunk : jobs per chunk
    layout : "shards" or "files"
    parts : number of coordinators, each with a scheduler; they share workers and rows evenly
    window : chunks in flight per worker
    draw, draw_spread : mean time of an image on one core; standard deviation relative to the mean
    chunk_start : time to load a mesh that is not cached, before the first image of a chunk
    slow_share, slow_factor : fraction of slow workers; their slowdown
    crashes, crash_cost : crashes of the rendering child per worker and hour; time for a new child
        and the repeated job
    losses, loss_found, loss_back : losses of a worker with its chunk, per hour; time until the
        scheduler sends the chunk to another worker, and until the worker is back
    coordinator_row, coordinator_chunk : time to read, check and hash a row; time to send a chunk
        and receive its result
    scheduler, scheduler_sigma : time per task; sigma of the logarithm of a message's time
    image_bytes, objects : total size and number of the files of a job
    put, put_sigma, puts : median latency of a request; sigma of its logarithm; concurrent requests
        of a worker
    request_limit : PUTs per second
    nic, link : bandwidth of a worker; bandwidth of all workers together to the store
    """

    workers: int = 128
    chunk: int = 100
    layout: str = "shards"
    parts: int = 1
    window: float = 3.0
    draw: float = 0.05
    draw_spread: float = 0.25
    chunk_start: float = 0.3
    slow_share: float = 0.02
    slow_factor: float = 3.0
    crashes: float = 0.1
    crash_cost: float = 2.5
    losses: float = 0.01
    loss_found: float = 30.0
    loss_back: float = 120.0
    coordinator_row: float = 5e-5
    coordinator_chunk: float = 2e-3
    scheduler: float = 2e-3
    scheduler_sigma: float = 0.5
    image_bytes: float = 1e5
    objects: int = 3
    put: float = 0.15
    put_sigma: float = 0.5
    puts: int = 1
    request_limit: float = 3500.0
    nic: float = 1.25e8
    link: float = 1.25e9

    @property
    def requests(self) -> int:
        """PUT requests per chunk: its shard or all files of its jobs, and its record."""
        return 1 + (1 if self.layout == "shards" else self.objects * self.chunk)

    def capacities(self) -> dict[str, float]:
        """Return the images per second that each component could process alone."""
        speed = 1.0 - self.slow_share + self.slow_share / self.slow_factor
        return {
            "workers": self.workers * speed / (self.draw + self.chunk_start / self.chunk),
            "coordinator": self.parts
            / (self.coordinator_row + self.coordinator_chunk / self.chunk),
            "scheduler": self.parts * self.chunk / self.scheduler,
            "requests": self.request_limit * self.chunk / self.requests,
            "link": self.link / self.image_bytes,
        }


@dataclass(frozen=True)
class Told:
    """The results of a simulation.

    Parameters
    ----------
    images : images per second
    full : fraction of time in which coordinators, schedulers, request limit and link were busy, and
        in which workers rendered ("workers") or waited for the store ("waiting")
    median, slowest : seconds from the start of a chunk until its record is stored: median and 99th
        percentile
    again : chunks per million that were lost and rendered again
    first : the component that limits the throughput
    """

    images: float
    full: Mapping[str, float]
    median: float
    slowest: float
    again: float
    first: str


class _Server:
    """A server that handles one request at a time, in the order of arrival.

    ``busy`` counts its busy seconds after the time ``after``.
    """

    def __init__(self, after: float) -> None:
        self.free = self.busy = 0.0
        self.after = after

    def serve(self, now: float, seconds: float) -> float:
        """Add a request that arrives at ``now``; return the time at which it is served."""
        start = max(now, self.free)
        self.free = start + seconds
        self.busy += max(self.free - max(start, self.after), 0.0)
        return self.free


class _Random:
    """Standard normal numbers and uniform numbers in [0, 1), generated 4096 at a time."""

    def __init__(self, seed: int) -> None:
        self.generator = np.random.Generator(np.random.PCG64(seed))
        self.normals: Iterator[float] = iter(())
        self.uniforms: Iterator[float] = iter(())

    def normal(self) -> float:
        for value in self.normals:
            return value
        self.normals = iter(self.generator.standard_normal(4096).tolist())
        return next(self.normals)

    def uniform(self) -> float:
        for value in self.uniforms:
            return value
        self.uniforms = iter(self.generator.random(4096).tolist())
        return next(self.uniforms)


def simulate(cluster: Cluster, seed: int = 1) -> Told:
    """Simulate a cluster for 15 chunks per worker, at least 60 s, after a warm-up.

    The warm-up is a quarter of this time, plus twice the time to fill the windows.
    """
    simulation = _Simulation(cluster, seed)
    simulation.run()
    return simulation.result()


class _Simulation:
    """The events of a cluster: coordinators send rows, schedulers pass tasks, workers render chunks
    and store them."""

    def __init__(self, cluster: Cluster, seed: int) -> None:
        parts, workers = range(cluster.parts), range(cluster.workers)
        self.cluster = cluster
        self.random = _Random(seed)
        self.seconds = max(15.0 * (cluster.chunk * cluster.draw + cluster.chunk_start), 60.0)
        self.sending = cluster.chunk * cluster.coordinator_row + cluster.coordinator_chunk
        filling = 2.0 * cluster.window * cluster.workers / cluster.parts * self.sending
        self.warm = 0.25 * self.seconds + filling
        self.end = self.warm + self.seconds
        self.coordinators = [_Server(self.warm) for _ in parts]
        self.schedulers = [_Server(self.warm) for _ in parts]
        self.requests, self.link = _Server(self.warm), _Server(self.warm)
        self.ready: list[deque[int]] = [deque() for _ in parts]
        self.idle = [[worker for worker in workers if worker % cluster.parts == n] for n in parts]
        self.begun = [0.0] * cluster.workers
        self.events: list[tuple[float, int, str, int, int]] = []  # time, number, kind, part, worker
        self.count = self.images = self.again = 0
        self.drawing = self.waiting = 0.0
        self.times: list[float] = []

    def run(self) -> None:
        """Handle events in the order of time until the end."""
        for part, idle in enumerate(self.idle):
            for _ in range(max(int(self.cluster.window * len(idle)), 1)):
                self._at(0.0, "row", part)
        while self.events and self.events[0][0] < self.end:
            now, _, kind, part, worker = heappop(self.events)
            if kind == "row":  # the coordinator has room in its window
                self._at(self.coordinators[part].serve(now, self.sending), "task", part)
            elif kind == "task":  # a chunk arrives at the scheduler
                self._at(self.schedulers[part].serve(now, self._message()), "ready", part)
            elif kind == "ready":
                self.ready[part].append(worker)
                self._give(part, now)
            elif kind == "store":
                self._store(now, part, worker)
            elif kind == "stored":
                if now >= self.warm:
                    self.images += self.cluster.chunk
                    self.times.append(now - self.begun[worker])
                self._at(self.schedulers[part].serve(now, self._message()), "row", part)
                self._at(now, "back", part, worker)
            elif kind == "back":
                self.idle[part].append(worker)
                self._give(part, now)

    def _at(self, time: float, kind: str, part: int, worker: int = -1) -> None:
        self.count += 1
        heappush(self.events, (time, self.count, kind, part, worker))

    def _since_warm(self, start: float, stop: float) -> float:
        """Return the part of a time span between the warm-up and the end."""
        return max(min(stop, self.end) - max(start, self.warm), 0.0)

    def _message(self) -> float:
        sigma = self.cluster.scheduler_sigma
        factor = math.exp(sigma * self.random.normal() - 0.5 * sigma * sigma)
        return 0.5 * self.cluster.scheduler * factor

    def _draw(self, worker: int) -> float:
        """Return a random time that a worker takes to render a chunk."""
        cluster = self.cluster
        spread = cluster.draw_spread / math.sqrt(cluster.chunk)
        draw = cluster.chunk * cluster.draw * max(1.0 + spread * self.random.normal(), 0.1)
        draw += cluster.chunk_start
        if worker < cluster.slow_share * cluster.workers:
            draw *= cluster.slow_factor
        if not self.begun[worker]:  # shorten the first chunk, so that workers are out of phase
            draw *= self.random.uniform()
        if self.random.uniform() < cluster.crashes * draw / 3600.0:
            draw += cluster.crash_cost
        return draw

    def _give(self, part: int, now: float) -> None:
        """Assign ready chunks to idle workers."""
        while self.ready[part] and self.idle[part]:
            self.ready[part].popleft()
            worker = self.idle[part].pop()
            draw = self._draw(worker)
            if self.random.uniform() < self.cluster.losses * draw / 3600.0:
                lost = now + draw * self.random.uniform()
                self._at(lost + self.cluster.loss_found, "task", part)
                self._at(lost + self.cluster.loss_back, "back", part, worker)
                self.again += 1
                continue
            self.drawing += self._since_warm(now, now + draw)
            self.begun[worker] = now
            self._at(now + draw, "store", part, worker)

    def _store(self, now: float, part: int, worker: int) -> None:
        """Store a rendered chunk, and its record last."""
        cluster = self.cluster
        size, n = cluster.chunk * cluster.image_bytes, cluster.requests
        after = (n - 1) / cluster.puts + 1.0  # latencies in sequence; the record comes last
        sigma = cluster.put_sigma
        mean = cluster.put * math.exp(0.5 * sigma * sigma)
        spread = mean * math.sqrt(math.expm1(sigma * sigma) * after)
        latency = max(after * mean + spread * self.random.normal(), 0.3 * after * cluster.put)
        sent = now + latency + size / cluster.nic
        stored = max(sent, self.requests.serve(now, n / cluster.request_limit))
        stored = max(stored, self.link.serve(now, size / cluster.link))
        self.waiting += self._since_warm(now, stored)
        self._at(stored, "stored", part, worker)

    def result(self) -> Told:
        """Return the results between the warm-up and the end."""
        cluster, seconds = self.cluster, self.seconds
        all_workers, all_parts = cluster.workers * seconds, cluster.parts * seconds
        busy = {
            "workers": self.drawing / all_workers,
            "waiting": self.waiting / all_workers,
            "coordinator": sum(server.busy for server in self.coordinators) / all_parts,
            "scheduler": sum(server.busy for server in self.schedulers) / all_parts,
            "requests": self.requests.busy / seconds,
            "link": self.link.busy / seconds,
        }
        full = {name: min(share, 1.0) for name, share in busy.items()}
        times = self.times
        median, slowest = np.quantile(times, (0.5, 0.99)) if times else (math.nan, math.nan)
        again = 1e6 * self.again * cluster.chunk / max(self.images, 1)
        first = _first(cluster, full)
        return Told(self.images / seconds, full, float(median), float(slowest), again, first)


def _first(cluster: Cluster, full: Mapping[str, float]) -> str:
    capacities = cluster.capacities()
    served = ("coordinator", "scheduler", "requests", "link")
    busy = [name for name in served if full[name] >= 0.9]
    if busy:
        return min(busy, key=capacities.__getitem__)
    return "workers" if full["workers"] > full["waiting"] else "waiting"


def measured(path: Path = MEASURED) -> Cluster:
    """Return a cluster of machines like the measured one, with enough workers for the target."""
    data = json.loads(path.read_text(encoding="utf-8"))
    draw, coordinator, busiest = data["draw"], data["coordinator"], data["scheduler"][-1]
    _, half, most = busiest["trip_s"]
    cluster = Cluster(
        draw=draw["image_s"],
        chunk_start=draw["load_s"],
        image_bytes=draw["bytes"]["shard"] + draw["bytes"]["record"],
        coordinator_row=coordinator["row_s"],
        coordinator_chunk=busiest["coordinator_s"],
        scheduler=busiest["scheduler_s"],
        scheduler_sigma=math.log(most / half) / 1.2816,  # the normal distribution's 90th percentile
    )
    return replace(cluster, workers=enough(cluster))


def enough(cluster: Cluster, share: float = 0.85) -> int:
    """Return the number of workers that meet the target at the utilisation ``share``.

    Machines have 16 workers, so the number is a multiple of 16.
    """
    each = cluster.capacities()["workers"] / cluster.workers
    return 16 * math.ceil(TARGET / share / each / 16.0)


HEAD = (
    *("", "images/s", "images a day", "workers rendering", "workers waiting for the store"),
    *("coordinator", "scheduler", "PUT requests", "link", "s per chunk: median, 99th percentile"),
    *("images rendered again, per 10^6", "bottleneck"),
)


def row(name: str, result: Told) -> list[str]:
    """Return the results of a simulation as a table row under HEAD."""
    parts = ("workers", "waiting", "coordinator", "scheduler", "requests", "link")
    shares = [f"{100.0 * result.full[part]:.0f} %" for part in parts]
    chunk = f"{result.median:.1f}, {result.slowest:.1f}"
    day = f"{result.images * 86400.0 / 1e6:.0f} M"
    return [name, f"{result.images:.0f}", day, *shares, chunk, f"{result.again:.0f}", result.first]


Runs = list[tuple[str, Cluster]]


def tables(base: Cluster) -> dict[str, Runs]:
    """Return the clusters of each row of the document's tables, by table title."""
    sized = [(f"{n} jobs", replace(base, chunk=n)) for n in (1, 10, 30, 100, 300, 1000)]
    workers = [base.workers * factor for factor in (1, 2, 4, 8, 16)]
    grown = [(f"{n} workers", replace(base, workers=n)) for n in workers]
    wide = replace(base, workers=workers[-1], link=10.0 * base.link)
    split: Runs = [
        (f"{wide.workers} workers, 1 coordinator, 10 times the link", wide),
        ("the same, 4 coordinators", replace(wide, parts=4)),
        ("the same, 16 coordinators", replace(wide, parts=16)),
    ]
    files = replace(base, layout="files")
    layouts: Runs = [
        ("shards", base),
        ("files, one PUT after the other", files),
        ("files, 16 PUTs at once", replace(files, puts=16)),
        ("the same, 2 times the workers", replace(files, puts=16, workers=2 * base.workers)),
        (
            "the same, 4 prefixes",
            replace(files, puts=16, workers=2 * base.workers, request_limit=4 * base.request_limit),
        ),
    ]
    wrong: Runs = [
        ("none", replace(base, crashes=0.0, losses=0.0, slow_share=0.0)),
        ("as above", base),
        ("20 % slow workers", replace(base, slow_share=0.2)),
        ("each child crashes 60 times an hour", replace(base, crashes=60.0)),
        ("each worker is lost once an hour", replace(base, losses=1.0)),
        ("the same, chunks of 1,000", replace(base, losses=1.0, chunk=1000)),
    ]
    return {
        "Jobs of a chunk": sized,
        "Workers": grown,
        "Several coordinators over parts of the table": split,
        "Layout": layouts,
        "What goes wrong": wrong,
    }


def sleepers(run: Mapping[str, Any]) -> Cluster:
    """Return the simulated cluster of a scheduler run of benchmarks/scale_measure.py, whose tasks
    only sleep."""
    none = ("draw_spread", "chunk_start", "slow_share", "crashes", "losses", "put")
    values: dict[str, Any] = dict.fromkeys((*none, "coordinator_row"), 0.0)
    values |= {"workers": run["slots"], "chunk": 1, "image_bytes": 1.0, "request_limit": 1e9}
    values |= {"draw": run["nap_s"], "scheduler": run["scheduler_s"]}
    return Cluster(**values, coordinator_chunk=run["coordinator_s"])


def simulated(path: Path) -> dict[str, Any]:
    """Return the data of the document: the results of each table row by title and name, and the
    simulated images per second of each measured scheduler run."""
    runs = json.loads(path.read_text(encoding="utf-8"))["scheduler"]
    return {
        "tables": {
            title: {name: asdict(simulate(cluster)) for name, cluster in clusters}
            for title, clusters in tables(measured(path)).items()
        },
        "scheduler": [simulate(sleepers(run)).images for run in runs],
    }


def main() -> None:
    from tools.docs.tables import markdown_table

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--measured", type=Path, default=MEASURED, help="measured values")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--chunk", type=int)
    parser.add_argument("--layout", choices=("shards", "files"))
    parser.add_argument("--parts", type=int)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="others")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="data of all tables")
    options = parser.parse_args()
    base = measured(options.measured)
    given: dict[str, Any] = {
        name: value
        for name in ("workers", "chunk", "layout", "parts")
        if (value := getattr(options, name)) is not None
    }
    numbers: dict[str, Any] = {
        each.name: type(each.default) for each in fields(Cluster) if each.name != "layout"
    }
    for name, _, value in (text.partition("=") for text in options.others):
        if name not in numbers:
            parser.error(f"unknown parameter {name}: choose from {', '.join(numbers)}")
        given[name] = numbers[name](float(value))
    if given:
        print(markdown_table(HEAD, [row("", simulate(replace(base, **given)))]))
        return
    data = simulated(options.measured)
    if options.output:
        options.output.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    for title, runs in data["tables"].items():
        rows = [row(name, Told(**run)) for name, run in runs.items()]
        print(f"## {title}\n\n{markdown_table(HEAD, rows)}\n")


if __name__ == "__main__":
    main()
