"""Arrays of a device read into memory that is kept."""

import numpy as np
import taichi as ti

from datagen.mpm.host_copy import HostCopy


def test_arrays_are_read_one_after_another():
    """Longer and shorter ones come as Taichi has them; the memory grows, and is taken again."""
    copy = HostCopy()
    kept = None
    for count in (3, 40, 8, 40):
        array = ti.ndarray(ti.f32, count)
        values = np.random.default_rng(count).random(count, np.float32)
        array.from_numpy(values)
        found = copy.read(array)
        assert found.dtype == np.float32 and np.array_equal(found, values)
        if kept is not None and count == 8:
            assert np.shares_memory(kept, found)
        kept = found
    copy.release()
    array = ti.ndarray(ti.f32, 2)
    array.from_numpy(np.float32([1, 2]))
    assert copy.read(array).tolist() == [1, 2]
    copy.release()
