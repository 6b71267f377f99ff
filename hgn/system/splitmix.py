"""Hashes neighbouring numbers to independent ones."""

MASK = (1 << 64) - 1


def splitmix64(state: int) -> int:
    """Returns splitmix64 (Steele, Lea & Flood 2014) of a 64-bit state: a bijection, independent for neighbours."""
    z = (state + 0x9E3779B97F4A7C15) & MASK
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & MASK
    z = (z ^ z >> 27) * 0x94D049BB133111EB & MASK
    return z ^ z >> 31
