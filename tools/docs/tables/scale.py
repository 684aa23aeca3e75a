"""Machines for 10^8 images a day, from measurements and a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from benchmarks import scale
from tools.docs.tables import load, markdown_table, row, table

SCHEDULER = (
    ("slots", "{slots} of {nap_s:g} s"),
    ("requested tasks/s", "{offered:.0f}"),
    ("measured tasks/s", "{done:.1f}"),
    ("simulated tasks/s", "{simulated:.1f}"),
    ("busy cores", "{busy:.2f} of {cores}"),
    ("scheduler, ms per task", "{scheduler_ms:.1f}"),
    ("coordinator, ms per task", "{coordinator_ms:.1f}"),
    ("workers, ms per task", "{workers_ms:.1f}"),
    ("round trip, ms: 10th, 50th, 90th percentile", "{trips}"),
)
PLAN_HEAD = ("part", "measured, or limit", "for 10^8 images a day", "utilisation")
PLAN = (
    (
        *("cores", "{draw_ms:.0f} ms per image, {base.chunk_start:.2f} s per chunk for its mesh"),
        *("{base.workers} in {machines} machines of 16", "{fraction[workers]:.1f%}"),
    ),
    ("chunks", "{base.chunk} jobs", "{shards:.1f}/s, {shards_day:.2f} M a day", ""),
    ("scheduler", "{scheduler_ms:.1f} ms per task", "1", "{fraction[scheduler]:.1f%}"),
    ("scheduler, if each job were a task", "", "{schedulers:.0f}", "{schedulers:.0f%}"),
    (
        *("coordinator", "{row_us:.0f} us per row, {chunk_ms:.1f} ms per chunk"),
        *("1", "{fraction[coordinator]:.1f%}"),
    ),
    ("storage", "{image_kb:.0f} kB per image", "{images_tb:.1f} TB a day", ""),
    (
        *("link to the store", "{link_gbit:.0f} Gbit/s"),
        *("{images_gbit:.2f} Gbit/s", "{fraction[link]:.1f%}"),
    ),
    ("objects, shards", "{shard_mb:.1f} MB per shard, and a record", "{objects:.1f} M a day", ""),
    (
        *("PUT requests, shards", "{base.request_limit:.0f}/s per prefix"),
        *("{shard_puts:.0f}/s", "{fraction[requests]:.1f%}"),
    ),
    (
        *("PUT requests, files", "{base.request_limit:.0f}/s per prefix"),
        *("{file_puts:.0f}/s", "{file_fraction:.1f%}"),
    ),
    (
        *("records, and final table", "{record_kb:.1f} and {table_kb:.1f} kB per job, JSON"),
        *("{record_gb:.0f} and {table_gb:.0f} GB a day", ""),
    ),
    ("rows sent to workers", "{sent:.0f} B per job, pickled", "{sent_gb:.0f} GB a day", ""),
    (
        *("second run: list finished chunks", "1,000 records per LIST request, one at a time"),
        *("{list_s:.0f} s", ""),
    ),
    ("second run: check the table", "{row_us:.0f} us per row", "{rows_h:.1f} h of one core", ""),
)
STORE = (
    ("store", "{place}"),
    ("layout", "{layout}"),
    ("parallel requests", "{parallel}"),
    ("requests", "{requests}"),
    ("median, ms", "{median_ms:.2f}"),
    ("99th percentile, ms", "{p99_ms:.1f}"),
    ("files/s", "{rate:.0f}"),
)


def blocks() -> dict[str, str]:
    data, simulated = load("scale"), load("scale_simulated")
    base, draw, store = scale.measured(), data["draw"], data["store"]
    chunk = base.draw * base.chunk + base.chunk_start
    return {
        "machine": "{date}: {processor}, {cores} cores".format(**data["machine"]),
        "opengl": "{renderer}, OpenGL {version}".format(**draw),
        "draw": f"{1e3 * base.draw:.0f} ms of CPU time per image, {1.0 / base.draw:.1f} images per"
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
                scale.HEAD, [scale.row(name, scale.Told(**run)) for name, run in runs.items()]
            )
            for title, runs in simulated["tables"].items()
        },
    }


def plan_values(base: scale.Cluster, data: dict[str, Any]) -> dict[str, Any]:
    """Return the values of PLAN: capacity of each part, and its load at the target rate.

    base : the cluster whose parts are loaded
    data : content of scale.json
    """
    target, size = scale.TARGET, base.image_bytes
    shards, sent = target / base.chunk, data["coordinator"]["chunk_bytes"] / base.chunk
    files = replace(base, layout="files")
    fraction = {name: target / value for name, value in base.capacities().items()}
    return {
        "base": base,
        "fraction": fraction,
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
        "file_fraction": target / files.capacities()["requests"],
        **{f"{name}_kb": data["draw"]["bytes"][name] / 1e3 for name in ("record", "table")},
        **{f"{name}_gb": data["draw"]["bytes"][name] / 10.0 for name in ("record", "table")},
        "sent": sent,
        "sent_gb": sent / 10.0,
        "list_s": 1e8 / base.chunk / 1000 * base.put,
        "rows_h": 1e8 * base.coordinator_row / 3600,
    }


def full_first(base: scale.Cluster) -> str:
    """Return the limiting rate of each part except the workers as text, lowest rate first."""
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
    """Yield each run of a scheduler on loopback, with the rate of its simulation."""
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
    """Yield the runs that wrote files or shards to a folder or to moto."""
    for name, run in store.items():
        if name == "bytes" or name.endswith("list"):
            continue
        place, layout, parallel = (*name.split(), "1")[:3]
        files = run["requests"] * (100 if layout == "shards" else 1)
        yield {
            **{"place": place, "layout": layout, "parallel": parallel, "requests": run["requests"]},
            **{"median_ms": 1e3 * run["median_s"], "p99_ms": 1e3 * run["p99_s"]},
            "rate": files / run["seconds"],
        }
