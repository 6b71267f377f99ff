"""What an update costs on many GPUs: messages, bytes and seconds, from 1 to 1,024 of them.

A model, and a rough one: every assumption is a field or stands in a docstring. jobs/SCALING.md compares it with what
was measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist


@dataclass(frozen=True)
class Link:
    """How one GPU reaches others, all GPUs of a job at once."""

    latency_s: float  # of one step of an all-reduce
    bytes_per_second: float  # each way


@dataclass(frozen=True)
class Cluster:
    """Nodes of equal GPUs."""

    node_gpus: int
    launch_s: float  # an all-reduce of nothing among one GPU
    inside: Link  # GPUs of one node
    between: Link  # GPUs of different nodes, each one's share of its node's network

    def nodes(self, gpus: int) -> int:
        return -(-gpus // self.node_gpus)


@dataclass(frozen=True)
class Step:
    """An update of one GPU alone."""

    seconds: float
    backward_seconds: float  # of these; messages go out while it runs
    messages: tuple[int, ...]  # bytes of each, in the order in which they go out
    spread: float  # standard deviation of a rank's seconds from update to update, as a share of their mean


@dataclass(frozen=True)
class Update:
    """An update on many GPUs. What is not hidden and what is waited for adds to the seconds of one GPU alone."""

    gpus: int
    nodes: int
    all_reduce_s: float  # all messages, one after the other
    not_hidden_s: float  # of that, what is left when the backward pass is done
    slowest_s: float  # mean time for which the slowest rank is waited
    seconds: float
    efficiency: float  # scenes per second and GPU, against one GPU alone


def all_reduce_seconds(byte_count: float, gpus: int, cluster: Cluster) -> float:
    """One all-reduce of `byte_count` bytes.

    Inside a node a ring: 2 (g - 1) steps, in which each GPU sends and receives 2 (g - 1) / g of the bytes (Patarasuk
    and Yuan 2009). Between nodes each GPU reduces the g-th part that is its own after the first half of the ring, in
    another ring or, where that is quicker, in a pair of trees of 2 log2(nodes) steps (Sanders, Speck and Träff 2009).
    """
    if gpus == 1:
        return 0.0
    inside, between, nodes = min(gpus, cluster.node_gpus), cluster.between, cluster.nodes(gpus)
    seconds = cluster.launch_s + _ring(byte_count, inside, cluster.inside)
    if nodes > 1:
        part = byte_count / inside
        trees = 2 * math.log2(nodes) * between.latency_s + 2 * part / between.bytes_per_second
        seconds += min(_ring(part, nodes, between), trees)
    return seconds


def sent_bytes(byte_count: float, gpus: int) -> float:
    """Bytes that each GPU sends, and receives, in an all-reduce."""
    return 2 * (gpus - 1) / gpus * byte_count


def update(step: Step, gpus: int, cluster: Cluster) -> Update:
    """An update of `gpus` GPUs with the same number of scenes each.

    The backward pass fills the messages at an even rate, a message leaves when it is full and the one before has
    arrived, and sending takes nothing from computing. The time of a rank is normally distributed about its mean, apart
    from the others', and all wait for the slowest.
    """
    total, filled, done = sum(step.messages), 0, 0.0
    seconds = [all_reduce_seconds(message, gpus, cluster) for message in step.messages]
    for message, message_s in zip(step.messages, seconds, strict=True):
        filled += message
        done = max(done, step.backward_seconds * filled / total) + message_s
    not_hidden_s = done - step.backward_seconds if gpus > 1 else 0.0
    slowest_s = expected_maximum(gpus) * step.spread * step.seconds
    whole = step.seconds + not_hidden_s + slowest_s
    return Update(gpus, cluster.nodes(gpus), sum(seconds), not_hidden_s, slowest_s, whole, step.seconds / whole)


def expected_maximum(count: int) -> float:
    """Mean of the largest of `count` standard normal numbers (Blom 1958; within 5 %)."""
    return NormalDist().inv_cdf((count - 0.375) / (count + 0.25))


def fit(measured: Sequence[tuple[int, float, float]]) -> tuple[float, Link]:
    """(launch seconds, link) of rings inside a node, from (GPUs, bytes, seconds) of all-reduces.

    Latencies are those of the smallest messages, the rate that of the largest among the fewest GPUs, so that all else
    is a test of the model. With only one number of GPUs the launch counts as latency.
    """
    smallest = {gpus: min(row for row in measured if row[0] == gpus)[2] for gpus in {row[0] for row in measured}}
    few, many = min(smallest), max(smallest)
    if many > few:
        latency_s = max(0.0, (smallest[many] - smallest[few]) / (2 * (many - few)))
        launch_s = max(0.0, smallest[few] - 2 * (few - 1) * latency_s)
    else:
        latency_s, launch_s = smallest[few] / (2 * (few - 1)), 0.0
    _, byte_count, seconds = max(row for row in measured if row[0] == few)
    return launch_s, Link(latency_s, sent_bytes(byte_count, few) / (seconds - smallest[few]))


def _ring(byte_count: float, gpus: int, link: Link) -> float:
    return 2 * (gpus - 1) * link.latency_s + sent_bytes(byte_count, gpus) / link.bytes_per_second
