"""The simulation of docs/measurements/scale.md: what is full first sets the rate, and is named."""

from dataclasses import replace

import pytest

from benchmarks.scale import Cluster, simulate

EVEN = Cluster(workers=64, slow_share=0.0, crashes=0.0, losses=0.0, put=0.01)


@pytest.mark.parametrize(
    ("first", "changes"),
    [
        ("workers", {}),
        ("coordinator", {"coordinator_row": 4e-3}),
        ("scheduler", {"scheduler": 0.4}),
        ("requests", {"layout": "files", "puts": 32, "request_limit": 500.0}),
        ("link", {"link": 2e7}),
    ],
)
def test_what_is_full_first_sets_the_rate(first, changes):
    cluster = replace(EVEN, **changes)
    capacities = cluster.capacities()
    told = simulate(cluster)
    assert told.first == min(capacities, key=capacities.get) == first
    assert told.images == pytest.approx(capacities[first], rel=0.1)


def test_workers_that_wait_for_one_request_after_the_other():
    told = simulate(replace(EVEN, layout="files", put=0.1))
    assert told.first == "waiting"
    assert told.images < 0.25 * min(EVEN.capacities().values())


def test_two_coordinators_carry_twice_what_one_does():
    full = replace(EVEN, coordinator_row=4e-3)
    one, two = simulate(full), simulate(replace(full, parts=2))
    assert two.images == pytest.approx(2.0 * one.images, rel=0.1)


def test_what_is_lost_is_drawn_again():
    calm, lossy = simulate(EVEN), simulate(replace(EVEN, losses=60.0, loss_back=60.0))
    assert calm.again == 0.0
    assert lossy.again > 0.0
    assert lossy.images < calm.images
