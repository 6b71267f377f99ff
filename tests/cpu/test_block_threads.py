"""Work in blocks on several threads."""

import pytest
import torch

from hgn.cpu.block_threads import for_each, single_threaded


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_each_block_is_worked_on_once(threads):
    """Whatever the number of threads, without gradients, in the caller's inference mode."""
    done, weight = torch.zeros(100, dtype=torch.int64), torch.ones(1, requires_grad=True)

    def work(block):
        assert torch.is_inference_mode_enabled() and not (weight * 2).requires_grad
        done[block] += 1

    with torch.inference_mode():
        for_each(work, range(100), threads)
    assert bool((done == 1).all())


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_block_is_raised(threads):
    """By whichever thread; the threads work on afterwards."""

    def work(block):
        if block == 7:
            raise ValueError("block 7")

    for _ in range(2):
        with pytest.raises(ValueError, match="block 7"):
            for_each(work, range(20), threads)


def test_threads_are_restored():
    """After an error, too."""
    before = torch.get_num_threads()
    with pytest.raises(ValueError, match="stop"), single_threaded():
        assert torch.get_num_threads() == 1
        raise ValueError("stop")
    assert torch.get_num_threads() == before
