"""What 10^8 images a day take, from measurements and a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks import scale
from tools.docs.tables import load, markdown_table, row, table

SCHEDULER = (
    ("slots", "{slots} of {nap_s:g} s"),
    ("asked for, a second", "{offered:.0f}"),
    ("measured", "{done:.1f}"),
    ("simulated", "{simulated:.1f}"),
    ("cores busy with it", "{busy:.2f} of {cores}"),
    ("scheduler, ms a task", "{scheduler_ms:.1f}"),
    ("coordinator, ms", "{coordinator_ms:.1f}"),
    ("workers, ms", "{workers_ms:.1f}"),
    ("round trip, ms: 10, 50, 90 %", "{trips}"),
)
PLAN_HEAD = ("", "measured, or granted", "at 10^8 images a day", "full")
PLAN = (
    (
        *("cores", "{draw_ms:.0f} ms an image, {base.chunk_start:.1f} s a chunk for its mesh"),
        *("{base.workers}, as {machines} machines of 16", "{share[workers]:.1f%}"),
    ),
    ("chunks", "{base.chunk} jobs", "{shards:.1f}/s, {shards_day:.2f} M a day", ""),
    ("scheduler", "{scheduler_ms:.1f} ms a task", "1", "{share[scheduler]:.1f%}"),
    ("scheduler, were a job a task", "", "{schedulers:.0f} of them", "{schedulers:.0f%}"),
    (
        *("coordinator", "{row_us:.0f} us a row, {chunk_ms:.1f} ms a chunk"),
        *("1", "{share[coordinator]:.1f%}"),
    ),
    ("storage", "{image_kb:.0f} kB an image", "{images_tb:.1f} TB a day", ""),
    (
        *("link to the store", "{link_gbit:.0f} Gbit/s"),
        *("{images_gbit:.2f} Gbit/s", "{share[link]:.1f%}"),
    ),
    ("objects, shards", "{shard_mb:.1f} MB a shard, and a record", "{objects:.1f} M a day", ""),
    (
        *("PUT requests, shards", "{base.request_limit:.0f}/s for a prefix"),
        *("{shard_puts:.0f}/s", "{share[requests]:.1f%}"),
    ),
    (
        *("PUT requests, files", "{base.request_limit:.0f}/s for a prefix"),
        *("{file_puts:.0f}/s", "{file_share:.1f%}"),
    ),
    (
        *("records, and the table of all", "{record_kb:.1f} and {table_kb:.1f} kB a job, JSON"),
        *("{record_gb:.0f} and {table_gb:.0f} GB a day", ""),
    ),
    ("rows to the workers", "{sent:.0f} B a job, pickled", "{sent_gb:.0f} GB a day", ""),
    (
        *("a second run of a day", "1,000 records a LIST request, 1 at a time"),
        *("{list_s:.0f} s to find what is done", ""),
    ),
    ("", "a row as above", "{rows_h:.1f} h of one core to read and check the table", ""),
)
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
        "plan": markdown_table(PLAN_HEAD, [row(cells, plan_values(base, data)) for cells in PLAN]),
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


def plan_values(base: scale.Cluster, data: dict[str, Any]) -> dict[str, Any]:
    """Return the values of PLAN: what the target takes of each part, and what one of it carries."""
    target, size = scale.TARGET, base.image_bytes
    shards, sent = target / base.chunk, data["coordinator"]["chunk_bytes"] / base.chunk
    files = replace(base, layout="files")
    share = {name: target / value for name, value in base.capacities().items()}
    return {
        "base": base,
        "share": share,
        "draw_ms": 1e3 * base.draw,
        "machines": base.workers // 16,
        "shards": shards,
        "shards_day": shards * 86400 / 1e6,
        "scheduler_ms": 1e3 * base.scheduler,
        "schedulers": target * base.scheduler,
        "row_us": 1e6 * base.coordinator_row,
        "chunk_ms": 1e3 * base.coordinator_chunk,
        "image_kb": size / 1e3,
        "images_tb": target * size * 86400 / 1e12,
        "link_gbit": base.link / 1.25e8,
        "images_gbit": target * size * 8 / 1e9,
        "shard_mb": base.chunk * size / 1e6,
        "objects": 2 * shards * 86400 / 1e6,
        "shard_puts": 2 * shards,
        "file_puts": target * files.requests / base.chunk,
        "file_share": target / files.capacities()["requests"],
        **{f"{name}_kb": data["draw"]["bytes"][name] / 1e3 for name in ("record", "table")},
        **{f"{name}_gb": data["draw"]["bytes"][name] / 10.0 for name in ("record", "table")},
        "sent": sent,
        "sent_gb": sent / 10.0,
        "list_s": 1e8 / base.chunk / 1000 * base.put,
        "rows_h": 1e8 * base.coordinator_row / 3600,
    }


def full_first(base: scale.Cluster) -> str:
    """Return the parts beside the workers in the order in which they are full, and the rates."""
    names = {
        "requests": "PUT requests",
        "link": "the link to the store",
        "coordinator": "the coordinator",
        "scheduler": "the scheduler",
    }
    rates = base.capacities()
    order = sorted(names, key=rates.__getitem__)
    return ", then ".join(f"{names[name]} at {round(rates[name]):,} images/s" for name in order)


def scheduler_rows(data: dict[str, Any], simulated: list[float]) -> Iterator[dict[str, Any]]:
    """Yield the runs of a real scheduler on loopback beside the simulated one."""
    for run, images in zip(data["scheduler"], simulated, strict=True):
        parts = {
            f"{name}_ms": 1e3 * run[f"{name}_s"] for name in ("scheduler", "coordinator", "workers")
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
