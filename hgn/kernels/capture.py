"""CUDA graphs of launches, captured in streams that are the same throughout a process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

Launches = Callable[[], None]

_streams: dict[int, tuple[torch.cuda.Stream, torch.cuda.Stream]] = {}


def captured(parts: Sequence[Launches], warm_up: Launches) -> list[torch.cuda.CUDAGraph]:
    """A graph of each of `parts`. `warm_up` runs before: it launches the same without changing anything that counts.

    cuBLAS keeps 32 MiB for each stream that it has run in; torch frees those of a capture's stream whenever a graph
    captured there ends, though another may read them. So the warm-up has a stream of its own: then what cuBLAS has in
    the capture's stream is part of the graph's memory, which lives as long as the graph.
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
