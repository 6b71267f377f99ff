"""What is told of errors."""

from __future__ import annotations

import pytest

from hgn.training.errors import told_gain


@pytest.mark.parametrize(
    ("gain", "text"),
    [(18.5, "18.50 times below"), (1.0, "1.00 times below"), (0.1, "10.00 times above")],
)
def test_gain_in_words(gain: float, text: str) -> None:
    """An error that is larger than the other is not said to be below it."""
    assert told_gain(gain) == text
