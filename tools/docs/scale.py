"""Writes docs/scale.md from what was measured and a simulation of it.

python benchmarks/scale_measure.py      # docs/measurements/scale.json; minutes, an idle machine
python -m tools.docs.scale
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import scale
from facerender.measure.tables import markdown_table
from tools.docs.template import missing

SCALE = Path(__file__).parents[2] / "docs/scale.md"
PLAN_HEAD = ("", "measured, or granted", "at 10^8 images a day", "full")
SLOTS_HEAD = (
    *("slots", "asked for, a second", "measured", "simulated", "cores busy with it"),
    *("scheduler, ms a task", "driver, ms", "workers, ms", "round trip, ms: 10, 50, 90 %"),
)
STORE_HEAD = ("to", "as", "at once", "requests", "median, ms", "99 %, ms", "files/s")


def plan_table(base: scale.Cluster, told: dict[str, Any]) -> str:
    """What the target takes of each part, beside what one of it carries."""
    target = scale.TARGET
    carries = base.capacities()
    shards = target / base.chunk
    files = replace(base, layout="files")
    size = base.image_bytes
    share = {name: f"{100 * target / value:.1f} %" for name, value in carries.items()}
    rows = [
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
    return markdown_table(PLAN_HEAD, rows)


def scheduler_table(runs: list[dict[str, Any]], cores: int) -> str:
    """A real scheduler on loopback beside the simulated one."""
    rows = []
    for run in runs:
        own = run["scheduler_s"] + run["driver_s"] + run["workers_s"]
        sleeper = scale.Cluster(
            workers=run["slots"],
            **{"chunk": 1, "draw": run["nap_s"], "draw_spread": 0.0, "chunk_start": 0.0},
            **{"slow_share": 0.0, "crashes": 0.0, "losses": 0.0, "put": 0.0, "image_bytes": 1.0},
            **{"driver_row": 0.0, "driver_chunk": run["driver_s"], "scheduler": run["scheduler_s"]},
            request_limit=1e9,
        )
        rows.append(
            [
                f"{run['slots']} of {run['nap_s']:g} s",
                f"{run['offered']:.0f}",
                f"{run['done']:.1f}",
                f"{scale.simulate(sleeper).images:.1f}",
                f"{run['done'] * own:.2f} of {cores}",
                *(f"{1e3 * run[name]:.1f}" for name in ("scheduler_s", "driver_s", "workers_s")),
                " / ".join(f"{1e3 * trip:.0f}" for trip in run["trip_s"]),
            ]
        )
    return markdown_table(SLOTS_HEAD, rows)


def store_table(told: dict[str, Any]) -> str:
    """Files and shards to a folder and to moto."""
    rows = []
    for name, run in told.items():
        if name == "bytes" or name.endswith("list"):
            continue
        where, what, at_once = (*name.split(), "1")[:3]
        images = run["requests"] * (100 if what == "shards" else 1)
        rows.append(
            [
                where,
                what,
                at_once,
                str(run["requests"]),
                f"{1e3 * run['median_s']:.2f}",
                f"{1e3 * run['p99_s']:.1f}",
                f"{images / run['seconds']:.0f}",
            ]
        )
    return markdown_table(STORE_HEAD, rows)


def text() -> str:
    """Return docs/scale.md."""
    told = json.loads(scale.MEASURED.read_text(encoding="utf-8"))
    base = scale.measured()
    machine, draw, store = told["machine"], told["draw"], told["store"]
    simulated = {
        title: markdown_table(scale.HEAD, [scale.row(*each) for each in runs])
        for title, runs in scale.tables(base).items()
    }
    capacities = base.capacities()
    each = {name: round(value) for name, value in capacities.items()}
    order = sorted((name for name in each if name != "workers"), key=each.__getitem__)
    called = {"requests": "PUT requests", "link": "the link to the store"}
    called |= {name: f"the {name}" for name in ("driver", "scheduler")}
    return (
        TEMPLATE.format(
            **machine,
            **{name: draw[name] for name in ("renderer", "version", "jobs")},
            ms=1e3 * base.draw,
            rate=1.0 / base.draw,
            start=draw["start_s"],
            kb={
                name: f"{draw['bytes'][f'{name}.png'] / 1e3:.1f}"
                for name in ("image", "mask", "depth")
            },
            plan=plan_table(base, told),
            order=", then ".join(f"{called[name]} at {each[name]:,} images/s" for name in order),
            feeds=round(base.parts * (base.draw * base.chunk + base.chunk_start) / base.scheduler),
            base=base,
            chunk_s=base.draw * base.chunk + base.chunk_start,
            scheduler=scheduler_table(told["scheduler"], machine["cores"]),
            store=store_table(store),
            remedies=markdown_table(["when", "then"], REMEDIES),
            listed=store["s3 list"],
            folder=store["folder list"],
            small=store["bytes"] / 1e3,
            simulated="\n\n".join(f"### {title}\n\n{table}" for title, table in simulated.items()),
        )
        + CLUSTERS
    )


REMEDIES = [
    [
        "the scheduler or the driver is full",
        "larger chunks, for what is paid by the chunk. Then parts: K drivers, each with a "
        "scheduler of its own, a Kth of the table and a folder of its own. They share nothing",
    ],
    [
        "requests are full",
        "`--layout shards`: 2 requests a chunk whatever it holds. Files need a prefix for each "
        "part, and many requests at once",
    ],
    ["the link is full", "workers near the store, fewer passes; shards are no fewer bytes"],
    ["the tail of a batch is long", "smaller chunks: it ends a slow worker's chunk after the rest"],
    ["a second run takes long", "parts, each with its own table, driver and folder; a day each"],
]

TEMPLATE = """# Scale: 10^8 images a day, and how to start a cluster

Written by `python -m tools.docs.scale`: tables from [measurements/scale.json](measurements/scale.json),
which `python benchmarks/scale_measure.py` wrote, and from a simulation, `python
benchmarks/scale.py`, which takes ten seconds on one core. Another machine, another image: run the
first, then `python benchmarks/scale.py --workers N --chunk N --layout files --set put=0.05`.

10^8 images a day are 1,157 a second. Here each is 256 x 256 pixels with 4 samples, three files:
image, mask, 16-bit depth. Measured on {date}: {processor}, {cores} cores, {renderer}, OpenGL
{version}.

## The plan

`facerender batch` took **{ms:.0f} ms of CPU time an image, {rate:.1f} images a second and core**:
all its processes, drawing, encoding and writing, in a batch of {jobs[1]} beside one of {jobs[0]},
so that its start ({start:.1f} s of CPU time) does not count. PNGs are {kb[image]} kB (image),
{kb[mask]} kB (mask) and {kb[depth]} kB (16-bit depth). Another CPU, mesh or size changes this, and
most figures below with it. The chunk of {base.chunk} jobs that share a mesh is the unit of
scheduling, of output and of commitment.

{plan}

Granted: Amazon S3 takes "at least 3,500 PUT/COPY/POST/DELETE [...] requests per second per
partitioned prefix" and grows with the load by itself, with 503 answers meanwhile; it names
latencies of small objects of "roughly 100-200 milliseconds"
([performance](https://docs.aws.amazon.com/AmazonS3/latest/userguide/optimizing-performance.html)).
Google Cloud Storage starts at about 1,000 object writes a second in a bucket and grows ([request
rates](https://cloud.google.com/storage/docs/request-rate)). The link of 10 Gbit/s, stragglers,
crashes and losses are assumed: they are the defaults of `Cluster` in `benchmarks/scale.py`.

**By this, one scheduler feeds about {feeds:,} workers** with chunks of {base.chunk} jobs,
{chunk_s:.1f} s each. Beyond workers, what breaks first of this plan, and where: {order}.

{remedies}

## The scheduler, measured

`dask scheduler` and two `dask worker` on loopback, with tasks that sleep and carry the rows of
{base.chunk} jobs, three in flight for each slot; scheduler, workers and driver share {cores}
cores here, on a cluster they do not. What the last run costs a task is what the plan and the
simulation take; round trips, with one task in flight, give its spread.

{scheduler}

The first runs ask for about as many chunks as the plan, and four times as many. They miss what is
simulated by the seconds in which slots fill and empty. The last two ask for more than {cores} cores
can do for four processes, and other work ran beside them: they show no limit of a scheduler with a
core of its own, which is what is simulated. More than 400 slots were not tried.

## The store, measured

Files of {small:.0f} kB, and shards of a hundred of them; one after the other or eight at once; to
a folder (written, then renamed) and to moto's S3 server on loopback through s3fs. moto is a
Python program on the same cores: it shows what a request costs a client at least, not what a
store does.

{store}

A list of {folder[found]:,} names took {folder[seconds]:.2f} s in the folder, of {listed[found]:,}
{listed[seconds]:.2f} s in moto.

## Simulated

A cluster as in the plan, {base.workers} workers, chunks of {base.chunk}, shards, one driver and
one scheduler, where a table says nothing else. Columns "workers draw" to "link" tell the share of
time in which each is busy; a worker that neither draws nor waits for the store waits for the
scheduler, or for a window of {base.window:g} chunks a worker. Slow workers take
{base.slow_factor:g} times as long, {base.slow_share:.0%} are slow. A mesh is loaded once a chunk,
so that small chunks load it more often.

{simulated}

What this leaves out: the table of all records, which the driver writes after the last chunk, a
network that drops, a scheduler that slows down as its tasks and workers grow in number, work
stealing, nodes that share disks and sockets, a store that throttles one client, and money.
"""

CLUSTERS = """
## How to start a cluster

Every machine needs the package with its extra, `pip install 'facerender[batch]'`, in the same
versions, and Mesa or a driver (`apt-get install libegl1 libgl1 libgl1-mesa-dri`); `facerender
doctor` tells whether it draws. The scheduler needs no OpenGL, but the package too, for it reads
what it hands on. Meshes and OUT are paths that mean the same everywhere: a shared folder, or for
OUT an address such as `s3://bucket/run` with its credentials in the environment of the workers.

- One worker is one process with one thread, `--nthreads 1`: a renderer serves one thread, and a
  software driver draws more with a process for each core than with threads. `LP_NUM_THREADS` is
  set for what draws; leave it alone.
- Dask kills no worker for its memory with `--memory-limit 0`; what draws is a child of the
  worker, which Dask does not count.
- Ports: 8786 of the scheduler to workers and driver; a worker listens too, `--worker-port
  40000:40100` and `--nanny-port 40101:40200` tell a firewall where; 8787 of the scheduler is the
  dashboard. Nothing is encrypted or asks who you are unless you give `--tls-ca-file`,
  `--tls-cert`, `--tls-key`: keep it inside.
- The driver, `facerender batch`, runs anywhere that reaches the scheduler and OUT; killed, the
  same command goes on.

### By hand

```
# one machine
dask scheduler --host 10.0.0.1 --port 8786
# every machine, a worker for each core
dask worker tcp://10.0.0.1:8786 --nthreads 1 --nworkers 16 --memory-limit 0
# anywhere
facerender batch jobs.jsonl -o /shared/out --layout shards --scheduler tcp://10.0.0.1:8786
```

On one machine, 127.0.0.1 in place of 10.0.0.1.

### SLURM

With dask-jobqueue, from a machine that workers reach. It asks for 16 jobs of 16 cores each;
`interface` is the network of the nodes:

```python
import subprocess
import sys

from dask_jobqueue import SLURMCluster

with SLURMCluster(
    queue="cpu",
    walltime="08:00:00",
    cores=16,
    processes=16,
    memory="32GB",
    interface="ib0",
    job_script_prologue=["source /shared/venv/bin/activate"],
    local_directory="/tmp",
) as cluster:
    cluster.scale(jobs=16)
    cluster.wait_for_workers(1)  # however long SLURM lets them wait; the rest join later
    batch = ["facerender", "batch", "jobs.jsonl", "-o", "/shared/out", "--layout", "shards"]
    sys.exit(subprocess.run([*batch, "--scheduler", cluster.scheduler_address]).returncode)
```

Without Dask, an array of jobs, each a batch of its own over a part of the table with a folder of
its own. Rows need an `id`, for the number of a row is another in its part; one job that is
stopped is started again alone.

```
split -n l/16 -d -a 2 --additional-suffix=.jsonl jobs.jsonl part-
```

```
#!/bin/bash
#SBATCH --array=0-15 --cpus-per-task=16 --mem=32G --time=08:00:00 --partition=cpu
source /shared/venv/bin/activate
part=part-$(printf %02d "$SLURM_ARRAY_TASK_ID")
facerender batch "$part.jsonl" -o "/shared/out/$part" --layout shards \\
    --workers "$SLURM_CPUS_PER_TASK"
```

### Kubernetes

An image with the package and Mesa:

```
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri \\
    && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir 'facerender[batch]' s3fs
```

With the operator of dask-kubernetes (`helm install --repo https://helm.dask.org
--create-namespace -n dask-operator --generate-name dask-kubernetes-operator`), one `DaskJob` is
scheduler, workers and driver; what it started goes when it ends. The secret `store` holds the
credentials of the object store.

```yaml
apiVersion: kubernetes.dask.org/v1
kind: DaskJob
metadata:
  name: faces
spec:
  job:
    spec:
      restartPolicy: OnFailure
      containers:
      - name: job
        image: REGISTRY/facerender:TAG
        args:  # 3 tells that some jobs failed: it is done
        - sh
        - -c
        - facerender batch /jobs/jobs.jsonl -o s3://bucket/run --layout shards
          --scheduler "$DASK_SCHEDULER_ADDRESS" || [ $? = 3 ]
        envFrom: [{secretRef: {name: store}}]
        volumeMounts: [{name: jobs, mountPath: /jobs}]
      volumes: [{name: jobs, persistentVolumeClaim: {claimName: jobs}}]
  cluster:
    spec:
      worker:
        replicas: 256
        spec:
          containers:
          - name: worker
            image: REGISTRY/facerender:TAG
            args: [dask, worker, --nthreads, "1", --memory-limit, "0", --name, $(DASK_WORKER_NAME)]
            envFrom: [{secretRef: {name: store}}]
            resources: {requests: {cpu: "1", memory: 2Gi}, limits: {cpu: "1", memory: 2Gi}}
            volumeMounts: [{name: jobs, mountPath: /jobs}]
          volumes: [{name: jobs, persistentVolumeClaim: {claimName: jobs}}]
      scheduler:
        spec:
          containers:
          - name: scheduler
            image: REGISTRY/facerender:TAG
            args: [dask, scheduler, --host, 0.0.0.0]
            ports:
            - {name: tcp-comm, containerPort: 8786}
            - {name: http-dashboard, containerPort: 8787}
            readinessProbe: {httpGet: {port: http-dashboard, path: /health}}
        service:
          type: ClusterIP
          selector: {dask.org/cluster-name: faces, dask.org/component: scheduler}
          ports:
          - {name: tcp-comm, port: 8786, targetPort: tcp-comm}
          - {name: http-dashboard, port: 8787, targetPort: http-dashboard}
```

Without the operator: a Deployment of one pod with `dask scheduler` and a Service of port 8786
named `scheduler`, a Deployment of workers with `dask worker tcp://scheduler:8786 --nthreads 1
--memory-limit 0`, and a Job for the driver.

### What of this was tried

On loopback, with dask 2026.8.0: the commands by hand, with nannies and both ranges of ports, and
the script for dask-jobqueue 0.9.0 with its `LocalCluster` in place of `SLURMCluster`, each on two
workers; their shards are those of two local workers, byte for byte. `split`, too, and what
`SLURMCluster.job_script()` writes. **Not tried here: SLURM itself, and Kubernetes.** The manifest
follows the operator's reference and what its `make_cluster_spec` writes (dask-kubernetes 2026.3.0),
and was read as YAML alone.
"""


def stale() -> Iterator[str]:
    """Tell what the document lacks of its words and of the heads of its tables."""
    yield from missing(SCALE, TEMPLATE + CLUSTERS, (PLAN_HEAD, SLOTS_HEAD, STORE_HEAD, scale.HEAD))


def main() -> None:
    SCALE.write_text(text(), encoding="utf-8")


if __name__ == "__main__":
    main()
