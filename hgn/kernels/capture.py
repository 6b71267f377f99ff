"""Captures CUDA graphs of launches in streams that stay the same throughout a process."""

from collections.abc import Callable, Sequence

import torch

Launches = Callable[[], None]

_streams: dict[int, tuple[torch.cuda.Stream, torch.cuda.Stream]] = {}


def captured(parts: Sequence[Launches], warm_up: Launches) -> list[torch.cuda.CUDAGraph]:
    """Returns a graph of each of `parts`. `warm_up` runs first: it makes the same launches without lasting changes.

    cuBLAS keeps 32 MiB for each stream in which it ran. PyTorch frees this memory of a capture's stream at the end of a
    graph captured there, even if another graph reads it. The warm-up therefore has its own stream. cuBLAS's memory in
    the capture's stream then belongs to the graph and lives as long as the graph.
    """
    device = torch.cuda.current_device()
    if device not in _streams:
        _streams[device] = torch.cuda.Stream(), torch.cuda.Stream()
    warm, capture = _streams[device]
    warm.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(warm):
        warm_up()
    torch.cuda.current_stream().wait_stream(warm)
    torch.cuda.synchronize()
    graphs = []
    for part in parts:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=capture, capture_error_mode="thread_local"):
            part()
        graphs.append(graph)
    return graphs
