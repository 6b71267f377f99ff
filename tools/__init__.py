import hgn  # noqa: F401 - before torch, whose threads then wait without spinning
