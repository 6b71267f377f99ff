"""Statistics merge to what a direct computation gives."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hgn.data.statistics import Moments, Statistics, episode_statistics


@settings(max_examples=50, deadline=None)
@given(sizes=st.lists(st.integers(0, 20), max_size=5), offset=st.sampled_from([0.0, 1.0, 1e6]))
def test_merged_moments_equal_direct_ones(sizes, offset):
    """However values are split into parts, mean and std are those of all of them, also far from zero."""
    generator = np.random.default_rng(sum(sizes))
    parts = [generator.normal(size=(size, 3)) + offset for size in sizes]
    merged = Moments()
    for part in parts:
        merged = merged.merge(Moments.of(part))
    values = np.concatenate([np.zeros((0, 3)), *parts])
    assert merged.count == len(values)
    if len(values):
        np.testing.assert_allclose(merged.mean, values.mean(axis=0), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(merged.std, values.std(axis=0), rtol=1e-8, atol=1e-12)
    else:
        assert merged == Moments() and merged.std == (0.0, 0.0, 0.0)


def test_too_short_or_empty_episodes_count_nothing():
    """One frame has no velocity, two have no acceleration, and an empty scene has neither."""
    assert episode_statistics(np.zeros((1, 4, 3), np.float32)) == Statistics()
    assert episode_statistics(np.zeros((2, 4, 3), np.float32)).acceleration == Moments()
    assert episode_statistics(np.zeros((5, 0, 3), np.float32)) == Statistics()
