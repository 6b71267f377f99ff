"""Training updates of several ranks on backend triton: averaged gradients, the same updates on all."""

import threading

import pytest
import torch
from kernels.test_update import episode, updates_of
from network.states import network_of
from processes import PATIENCE_S

pytestmark = pytest.mark.usefixtures("large_tiles")


def run_together(ranks, chunks, rates):
    """Runs each rank in a thread, one at a time, until all want their gradients summed; how often each rank did."""
    turn, meeting = threading.Lock(), threading.Barrier(len(ranks), timeout=PATIENCE_S)
    waiting: dict[int, torch.Tensor] = {}
    sums = [0] * len(ranks)

    def run(rank):
        def reduce(tensor):
            waiting[rank] = tensor
            sums[rank] += 1
            turn.release()
            if meeting.wait() == 0:
                total = torch.stack(list(waiting.values())).sum(0)
                for each in waiting.values():
                    each.copy_(total)
            meeting.wait()
            turn.acquire()

        ranks[rank].reduce, ranks[rank].ranks = reduce, len(ranks)
        with turn:
            ranks[rank].run(chunks[rank], rates)

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(len(ranks))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sums


def test_two_ranks_update_as_one():
    """Two ranks with a scene each have the gradient of one with both (to 1e-6) and stay bitwise equal; where one of
    them lacks room both repeat the update."""
    network = network_of(width=16, levels=1, message_passing_steps=1, cell_size=0.1).float()
    (first, _), (second, _) = episode(1, 5, True), episode(2, 3, False, spread=0.6)
    together = updates_of(network, 2, capacities=(512,))
    together.run([[(first, 0, 1), (second, 1, 2)]], [1e-3])
    ranks = [updates_of(network, 1, capacities=(512,)), updates_of(network, 1, capacities=(16,))]
    sums = run_together(ranks, [[[(first, 0, 1)]], [[(second, 1, 2)]]], [1e-3])
    assert sums == [2, 2] and ranks[1].growths == 1  # one update, repeated
    expected = together.first_moment  # a tenth of the gradient
    for rank in ranks:
        difference = float((rank.first_moment - expected).abs().max())
        assert difference <= 1e-7 * max(1.0, 10 * float(expected.abs().max()))
        assert torch.equal(rank.values, ranks[0].values) and int(rank.step) == 1
    assert float(expected.abs().max()) > 1e-3
