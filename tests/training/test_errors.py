"""What is told of errors."""

import numpy as np
import pytest

from hgn.training.errors import format_ratio, mean_so_far


@pytest.mark.parametrize(
    ("gain", "text"),
    [
        (18.5, "18.50 times below"),
        (1.0, "1.00 times below"),
        (0.1, "10.00 times above"),
        (3.78e7, "3.8e+07 times below"),
    ],
)
def test_gain_in_words(gain, text):
    """An error that is larger than the other is not said to be below it. A bar shows it shorter."""
    assert (format_ratio(gain), format_ratio(gain, 1, "x")) == (
        text,
        text.replace("0 times", "x").replace(" times", "x"),
    )


def test_mean_over_the_scenes_that_came_so_far():
    """A scene that ended counts in no frame behind its end; behind the last one there is no mean."""
    none = np.nan
    value_ST = np.array([[1.0, 2.0, none, none], [3.0, 6.0, 9.0, none]])
    np.testing.assert_array_equal(mean_so_far(value_ST), [2.0, 4.0, 9.0, none])
