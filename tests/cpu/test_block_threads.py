"""Work in blocks on several threads."""

import pytest
import torch

from hgn.cpu.block_threads import for_each, single_threaded


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_blocks(threads):
    """Each block is worked on once, without gradients, in the caller's inference mode. An error in a block is raised by
    whichever thread, and the threads work on afterwards."""
    done, weight, failing = torch.zeros(100, dtype=torch.int64), torch.ones(1, requires_grad=True), [7]

    def work(block):
        if block in failing:
            raise ValueError("block 7")
        assert torch.is_inference_mode_enabled() and not (weight * 2).requires_grad
        done[block] += 1

    with torch.inference_mode():
        for _ in range(2):
            with pytest.raises(ValueError, match="block 7"):
                for_each(work, range(100), threads)
        failing.clear()
        done.zero_()
        for_each(work, range(100), threads)
    assert bool((done == 1).all())


def test_threads_are_restored():
    """After an error, too."""
    before = torch.get_num_threads()
    with pytest.raises(ValueError, match="stop"), single_threaded():
        assert torch.get_num_threads() == 1
        raise ValueError("stop")
    assert torch.get_num_threads() == before
