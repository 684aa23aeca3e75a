"""Tests the simulation of docs/measurements/scale.md: the smallest capacity sets the rate and is
named."""

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
def test_smallest_capacity_sets_the_rate(first, changes):
    cluster = replace(EVEN, **changes)
    capacities = cluster.capacities()
    result = simulate(cluster)
    assert result.first == min(capacities, key=capacities.get) == first
    assert result.images == pytest.approx(capacities[first], rel=0.1)


def test_sequential_requests_make_workers_wait():
    result = simulate(replace(EVEN, layout="files", put=0.1))
    assert result.first == "waiting"
    assert result.images < 0.25 * min(EVEN.capacities().values())


def test_two_coordinators_double_the_rate():
    full = replace(EVEN, coordinator_row=4e-3)
    one, two = simulate(full), simulate(replace(full, parts=2))
    assert two.images == pytest.approx(2.0 * one.images, rel=0.1)


def test_lost_images_are_drawn_again():
    calm, lossy = simulate(EVEN), simulate(replace(EVEN, losses=60.0, loss_back=60.0))
    assert calm.again == 0.0
    assert lossy.again > 0.0
    assert lossy.images < calm.images
