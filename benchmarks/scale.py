"""A batch on a cluster, simulated: which part of it is full first, and at how many images a second.

    python -m benchmarks.scale [--workers N] [--chunk N] [--layout shards|files] [--parts N]
        [--set NAME=VALUE ...] [--measured docs/measurements/scale.json] [-o FILE.json]

Without options: the tables of docs/measurements/scale.md; with -o, their data for `python -m
tools.docs`, as docs/measurements/scale_simulated.json. A model of events, in one process, in
seconds:

- A coordinator of each part reads and digests rows, and keeps a window of chunks in flight.
- A scheduler of each part serves one message after the other: half of a task's time when it comes,
  half when it is done; times are lognormal.
- Workers draw a chunk at a time; some are slow, their children crash, they are lost. One that has
  ended takes what its scheduler has passed next, as Dask's workers hold a task in advance.
- The store answers each worker's requests one after the other, or some at once, with lognormal
  latencies; a worker draws on when its record is there. All requests pass a limit a second, all
  bytes one link, both as fluids: those of a chunk take their turn whole.

What is measured comes from docs/measurements/scale.json, which benchmarks/scale_measure.py writes;
the rest is a field of Cluster with its source. Same seed, same figures.
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
TARGET = 1e8 / 86400.0  # images a second


@dataclass(frozen=True)
class Cluster:
    """What is simulated. Times in seconds, sizes in bytes, rates a second unless said otherwise.

    Measured here: draw, chunk_start, image_bytes, coordinator_row, coordinator_chunk, scheduler and
    scheduler_sigma. Public: request_limit is what Amazon S3 grants PUTs to a prefix, put lies
    in the middle of the latencies of small objects that it names ("Best practices design patterns:
    optimizing Amazon S3 performance"). The rest is assumed.

    Parameters
    ----------
    workers, chunk, layout, parts, window : processes that draw; jobs of a chunk; "shards" or
        "files"; coordinators with a scheduler of their own, which share workers and rows evenly;
        chunks in flight for each worker
    draw, draw_spread : of an image on one core; its standard deviation over its mean
    chunk_start : before the first image of a chunk: a mesh that is not kept
    slow_share, slow_factor : workers that are slow, and how much
    crashes, crash_cost : of a drawing child, an hour and worker; a new child and the job again
    losses, loss_found, loss_back : of a worker with its chunk, an hour; until the scheduler sends
        the chunk to another, and until the worker is back
    coordinator_row, coordinator_chunk : to read, check and digest a row; to send a chunk and take
        its result
    scheduler, scheduler_sigma : a task; of the logarithm of a message's time
    image_bytes, objects : of all files of a job; how many these are
    put, put_sigma, puts, request_limit : median latency of a request, sigma of its logarithm; how
        many a worker sends at once; PUTs a second
    nic, link : bytes a second of a worker, and of all to the store
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
        """PUTs of a chunk: its shard, or a file for each pass of each job; and its record."""
        return 1 + (1 if self.layout == "shards" else self.objects * self.chunk)

    def capacities(self) -> dict[str, float]:
        """Images a second that each part of it can carry by itself."""
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
    """What a simulation tells.

    Parameters
    ----------
    images : a second
    full : the share of time in which coordinators, schedulers, requests and link were busy, and
        workers drew, or waited for the store
    median, slowest : seconds from a worker's start of a chunk to its record, of half of the chunks
        and of all but 1 %
    again : chunks that were lost and drawn again, of a million
    first : what is full: what keeps the rest from being faster
    """

    images: float
    full: Mapping[str, float]
    median: float
    slowest: float
    again: float
    first: str


class _Server:
    """Serves in the order of arrival, one at a time; counts how long it was busy after a time."""

    def __init__(self, after: float) -> None:
        self.free = self.busy = 0.0
        self.after = after

    def serve(self, now: float, seconds: float) -> float:
        """Return when it has served what comes now."""
        start = max(now, self.free)
        self.free = start + seconds
        self.busy += max(self.free - max(start, self.after), 0.0)
        return self.free


class _Random:
    """Standard normal numbers and numbers in [0, 1), drawn by the thousand."""

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
    """Run a cluster for fifteen chunks of a worker, after four and twice what fills the windows."""
    simulation = _Simulation(cluster, seed)
    simulation.run()
    return simulation.told()


class _Simulation:
    """The events of a cluster: rows sent by coordinators, tasks passed by schedulers, chunks drawn
    by workers and stored."""

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
        self.events: list[tuple[float, int, str, int, int]] = []  # time, number, what, part, worker
        self.count = self.images = self.again = 0
        self.drawing = self.waiting = 0.0
        self.times: list[float] = []

    def run(self) -> None:
        """Handle events in the order of time until the end."""
        for part, idle in enumerate(self.idle):
            for _ in range(max(int(self.cluster.window * len(idle)), 1)):
                self._at(0.0, "row", part)
        while self.events and self.events[0][0] < self.end:
            now, _, what, part, worker = heappop(self.events)
            if what == "row":  # the coordinator has room in its window
                self._at(self.coordinators[part].serve(now, self.sending), "task", part)
            elif what == "task":  # a chunk comes to the scheduler
                self._at(self.schedulers[part].serve(now, self._message()), "ready", part)
            elif what == "ready":
                self.ready[part].append(worker)
                self._give(part, now)
            elif what == "store":
                self._store(now, part, worker)
            elif what == "stored":
                if now >= self.warm:
                    self.images += self.cluster.chunk
                    self.times.append(now - self.begun[worker])
                self._at(self.schedulers[part].serve(now, self._message()), "row", part)
                self._at(now, "back", part, worker)
            elif what == "back":
                self.idle[part].append(worker)
                self._give(part, now)

    def _at(self, time: float, what: str, part: int, worker: int = -1) -> None:
        self.count += 1
        heappush(self.events, (time, self.count, what, part, worker))

    def _since_warm(self, start: float, stop: float) -> float:
        """Return how much of a span counts."""
        return max(min(stop, self.end) - max(start, self.warm), 0.0)

    def _message(self) -> float:
        sigma = self.cluster.scheduler_sigma
        factor = math.exp(sigma * self.random.normal() - 0.5 * sigma * sigma)
        return 0.5 * self.cluster.scheduler * factor

    def _draw(self, worker: int) -> float:
        """Return how long a worker draws a chunk."""
        cluster = self.cluster
        spread = cluster.draw_spread / math.sqrt(cluster.chunk)
        draw = cluster.chunk * cluster.draw * max(1.0 + spread * self.random.normal(), 0.1)
        draw += cluster.chunk_start
        if worker < cluster.slow_share * cluster.workers:
            draw *= cluster.slow_factor
        if not self.begun[worker]:  # so that workers are out of step
            draw *= self.random.uniform()
        if self.random.uniform() < cluster.crashes * draw / 3600.0:
            draw += cluster.crash_cost
        return draw

    def _give(self, part: int, now: float) -> None:
        """Give the chunks that are ready to idle workers."""
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
        """Write a chunk that is drawn, and its record after it."""
        cluster = self.cluster
        size, n = cluster.chunk * cluster.image_bytes, cluster.requests
        after = (n - 1) / cluster.puts + 1.0  # one after the other; the record comes last
        sigma = cluster.put_sigma
        mean = cluster.put * math.exp(0.5 * sigma * sigma)
        spread = mean * math.sqrt(math.expm1(sigma * sigma) * after)
        latency = max(after * mean + spread * self.random.normal(), 0.3 * after * cluster.put)
        sent = now + latency + size / cluster.nic
        stored = max(sent, self.requests.serve(now, n / cluster.request_limit))
        stored = max(stored, self.link.serve(now, size / cluster.link))
        self.waiting += self._since_warm(now, stored)
        self._at(stored, "stored", part, worker)

    def told(self) -> Told:
        """Return what was counted between the warm-up and the end."""
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
    """A cluster of machines such as the one that was measured, as many as the target takes."""
    told = json.loads(path.read_text(encoding="utf-8"))
    draw, coordinator, busiest = told["draw"], told["coordinator"], told["scheduler"][-1]
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
    """Workers that draw the target in this share of their time, whole machines of 16."""
    each = cluster.capacities()["workers"] / cluster.workers
    return 16 * math.ceil(TARGET / share / each / 16.0)


HEAD = (
    *("", "images/s", "in a day", "workers draw", "wait for the store", "coordinator", "scheduler"),
    *("PUT requests", "link", "a chunk, s: half, 99 %", "lost and again, of 10^6", "full first"),
)


def row(name: str, told: Told) -> list[str]:
    """Return what a simulation tells as a row under HEAD."""
    parts = ("workers", "waiting", "coordinator", "scheduler", "requests", "link")
    shares = [f"{100.0 * told.full[part]:.0f} %" for part in parts]
    chunk = f"{told.median:.1f}, {told.slowest:.1f}"
    day = f"{told.images * 86400.0 / 1e6:.0f} M"
    return [name, f"{told.images:.0f}", day, *shares, chunk, f"{told.again:.0f}", told.first]


Runs = list[tuple[str, Cluster]]


def tables(base: Cluster) -> dict[str, Runs]:
    """What the document shows: by title, the clusters of each row."""
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
    """Return the cluster of a run of benchmarks/scale_measure.py, whose tasks only sleep."""
    none = ("draw_spread", "chunk_start", "slow_share", "crashes", "losses", "put")
    values: dict[str, Any] = dict.fromkeys((*none, "coordinator_row"), 0.0)
    values |= {"workers": run["slots"], "chunk": 1, "image_bytes": 1.0, "request_limit": 1e9}
    values |= {"draw": run["nap_s"], "scheduler": run["scheduler_s"]}
    return Cluster(**values, coordinator_chunk=run["coordinator_s"])


def simulated(path: Path) -> dict[str, Any]:
    """Return the data of the document: what each row of its tables tells, by title and name; and
    the images a second of each measured run of a scheduler."""
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
    parser.add_argument("--measured", type=Path, default=MEASURED, help="of another machine")
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
            parser.error(f"no parameter {name}; there are {', '.join(numbers)}")
        given[name] = numbers[name](float(value))
    if given:
        print(markdown_table(HEAD, [row("", simulate(replace(base, **given)))]))
        return
    data = simulated(options.measured)
    if options.output:
        options.output.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    for title, runs in data["tables"].items():
        rows = [row(name, Told(**told)) for name, told in runs.items()]
        print(f"## {title}\n\n{markdown_table(HEAD, rows)}\n")


if __name__ == "__main__":
    main()
