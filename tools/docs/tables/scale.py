"""What 10^8 images a day take, from measurements and a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks import scale
from facerender.measure.tables import markdown_table
from tools.docs.tables import load, table

SCHEDULER = (
    ("slots", "{slots} of {nap_s:g} s"),
    ("asked for, a second", "{offered:.0f}"),
    ("measured", "{done:.1f}"),
    ("simulated", "{simulated:.1f}"),
    ("cores busy with it", "{busy:.2f} of {cores}"),
    ("scheduler, ms a task", "{scheduler_ms:.1f}"),
    ("driver, ms", "{driver_ms:.1f}"),
    ("workers, ms", "{workers_ms:.1f}"),
    ("round trip, ms: 10, 50, 90 %", "{trips}"),
)
PLAN_HEAD = ("", "measured, or granted", "at 10^8 images a day", "full")
STORE = (
    ("to", "{where}"),
    ("as", "{what}"),
    ("at once", "{at_once}"),
    ("requests", "{requests}"),
    ("median, ms", "{median_ms:.2f}"),
    ("99 %, ms", "{p99_ms:.1f}"),
    ("files/s", "{rate:.0f}"),
)


def blocks() -> dict[str, str]:
    data, simulated = load("scale"), load("scale_simulated")
    base, draw, store = scale.measured(), data["draw"], data["store"]
    chunk = base.draw * base.chunk + base.chunk_start
    return {
        "machine": "{date}: {processor}, {cores} cores".format(**data["machine"]),
        "opengl": "{renderer}, OpenGL {version}".format(**draw),
        "draw": f"{1e3 * base.draw:.0f} ms of CPU time an image, {1.0 / base.draw:.1f} images a"
        " second and core",
        "start": f"{draw['start_s']:.1f} s",
        **{
            f"{name}-kb": f"{draw['bytes'][f'{name}.png'] / 1e3:.1f} kB"
            for name in ("image", "mask", "depth")
        },
        "plan": markdown_table(PLAN_HEAD, plan_rows(base, data)),
        "feeds": f"{round(base.parts * chunk / base.scheduler):,} workers",
        "chunk": f"{chunk:.1f} s",
        "full-first": full_first(base),
        "scheduler": table(SCHEDULER, scheduler_rows(data, simulated["scheduler"])),
        "store": table(STORE, store_rows(store)),
        **{
            f"{at}-list": "{found:,} names took {seconds:.2f} s".format(**store[f"{at} list"])
            for at in ("folder", "s3")
        },
        **{
            title.lower().replace(" ", "-"): markdown_table(
                scale.HEAD, [scale.row(name, scale.Told(**told)) for name, told in runs.items()]
            )
            for title, runs in simulated["tables"].items()
        },
    }


def plan_rows(base: scale.Cluster, told: dict[str, Any]) -> list[list[str]]:
    """Return what the target takes of each part, beside what one of it carries."""
    target = scale.TARGET
    carries = base.capacities()
    shards = target / base.chunk
    files = replace(base, layout="files")
    size = base.image_bytes
    share = {name: f"{100 * target / value:.1f} %" for name, value in carries.items()}
    return [
        [
            "cores",
            f"{base.draw * 1e3:.0f} ms an image, {base.chunk_start:.1f} s a chunk for its mesh",
            f"{base.workers}, as {base.workers // 16} machines of 16",
            share["workers"],
        ],
        ["chunks", f"{base.chunk} jobs", f"{shards:.1f}/s, {shards * 86400 / 1e6:.2f} M a day", ""],
        ["scheduler", f"{base.scheduler * 1e3:.1f} ms a task", "1", share["scheduler"]],
        [
            "scheduler, were a job a task",
            "",
            f"{target * base.scheduler:.0f} of them",
            f"{100 * target * base.scheduler:.0f} %",
        ],
        [
            "driver",
            f"{base.driver_row * 1e6:.0f} us a row, {base.driver_chunk * 1e3:.1f} ms a chunk",
            "1",
            share["driver"],
        ],
        [
            "storage",
            f"{size / 1e3:.0f} kB an image",
            f"{target * size * 86400 / 1e12:.1f} TB a day",
            "",
        ],
        [
            "link to the store",
            f"{base.link / 1.25e8:.0f} Gbit/s",
            f"{target * size * 8 / 1e9:.2f} Gbit/s",
            share["link"],
        ],
        [
            "objects, shards",
            f"{base.chunk * size / 1e6:.1f} MB a shard, and a record",
            f"{2 * shards * 86400 / 1e6:.1f} M a day",
            "",
        ],
        [
            "PUT requests, shards",
            f"{base.request_limit:.0f}/s for a prefix",
            f"{2 * shards:.0f}/s",
            share["requests"],
        ],
        [
            "PUT requests, files",
            f"{base.request_limit:.0f}/s for a prefix",
            f"{target * files.requests / base.chunk:.0f}/s",
            f"{100 * target / files.capacities()['requests']:.1f} %",
        ],
        [
            "records, and the table of all",
            f"{told['draw']['bytes']['record'] / 1e3:.1f} and "
            f"{told['draw']['bytes']['table'] / 1e3:.1f} kB a job, JSON",
            f"{1e8 * told['draw']['bytes']['record'] / 1e9:.0f} and "
            f"{1e8 * told['draw']['bytes']['table'] / 1e9:.0f} GB a day",
            "",
        ],
        [
            "rows to the workers",
            f"{told['driver']['chunk_bytes'] / base.chunk:.0f} B a job, pickled",
            f"{1e8 * told['driver']['chunk_bytes'] / base.chunk / 1e9:.0f} GB a day",
            "",
        ],
        [
            "a second run of a day",
            "1,000 records a LIST request, 1 at a time",
            f"{1e8 / base.chunk / 1000 * base.put:.0f} s to find what is done",
            "",
        ],
        [
            "",
            "a row as above",
            f"{1e8 * base.driver_row / 3600:.1f} h of one core to read and check the table",
            "",
        ],
    ]


def full_first(base: scale.Cluster) -> str:
    """Return the parts beside the workers in the order in which they are full, and the rates."""
    names = {
        "requests": "PUT requests",
        "link": "the link to the store",
        "driver": "the driver",
        "scheduler": "the scheduler",
    }
    rates = base.capacities()
    order = sorted(names, key=rates.__getitem__)
    return ", then ".join(f"{names[name]} at {round(rates[name]):,} images/s" for name in order)


def scheduler_rows(data: dict[str, Any], simulated: list[float]) -> Iterator[dict[str, Any]]:
    """Yield the runs of a real scheduler on loopback beside the simulated one."""
    for run, images in zip(data["scheduler"], simulated, strict=True):
        parts = {
            f"{name}_ms": 1e3 * run[f"{name}_s"] for name in ("scheduler", "driver", "workers")
        }
        yield {
            **run,
            **parts,
            "simulated": images,
            "busy": run["done"] * 1e-3 * sum(parts.values()),
            "cores": data["machine"]["cores"],
            "trips": " / ".join(f"{1e3 * trip:.0f}" for trip in run["trip_s"]),
        }


def store_rows(store: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the runs of files and of shards to a folder and to moto."""
    for name, run in store.items():
        if name == "bytes" or name.endswith("list"):
            continue
        where, what, at_once = (*name.split(), "1")[:3]
        files = run["requests"] * (100 if what == "shards" else 1)
        yield {
            **{"where": where, "what": what, "at_once": at_once, "requests": run["requests"]},
            **{"median_ms": 1e3 * run["median_s"], "p99_ms": 1e3 * run["p99_s"]},
            "rate": files / run["seconds"],
        }
