"""Error and cost of simplified meshes."""

from __future__ import annotations

from tools.docs.tables import load, machine, table

COLUMNS = (
    ("triangles", "{triangles:,}"),
    ("> 1/255", "{over_1:.2g%}"),
    ("> 2/255", "{over_2:.2g%}"),
    ("> 4/255", "{over_4:.2g%}"),
    ("mean, levels", "{mean:.2f}"),
    ("silhouette shift, pixels", "{silhouette:.1f}"),
    ("time, 1 sample", "{time[0]:.2f}"),
    ("time, 4 samples", "{time[1]:.2f}"),
)


def blocks() -> dict[str, str]:
    data = load("levels")
    full, _, simplified, *_ = data["levels"]["head-512"]
    return {
        "machine": machine(data),
        "example": f"{simplified['triangles']:,} of its {full['triangles']:,} triangles takes"
        f" {simplified['time'][0]:.2f} times as long. In this image"
        f" {100 * simplified['over_1']:.0f} % of the pixels change by more than one 8-bit level",
        "seconds": f"{data['seconds']:.1f} s",
        **{name: table(COLUMNS, levels) for name, levels in data["levels"].items()},
    }
