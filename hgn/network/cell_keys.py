"""Integer keys of grid cells: scene index and cell coordinates packed into one int64.

Sorted keys group cells by scene, and keys of neighbours differ by a constant. So one sorted list represents all scenes
of a batch. Shape legend: … any leading shape, B hash buckets.
"""

import math

import torch
from torch.compiler import is_exporting

COORDINATE_BITS = 17
COORDINATE_LIMIT = 1 << (COORDINATE_BITS - 1)  # coordinates range from -limit to limit - 1 on each axis
SCENE_LIMIT = 1 << (63 - 3 * COORDINATE_BITS)
HASH_PRIMES = (73856093, 19349663, 83492791)  # factors of x, y, z (Teschner et al. 2003); products stay far below 2^63
LARGEST_EXPORTED = 1 << 24  # upper bound of particles or cells in an exported graph; compilers need one
AXIS_STRIDE = (1 << (2 * COORDINATE_BITS), 1 << COORDINATE_BITS, 1)  # key difference of neighbours in x, y, z


def pack(scene: torch.Tensor, cell_3: torch.Tensor) -> torch.Tensor:
    """Returns keys int64 […] of scene indices int64 […] and cell coordinates int64 […, 3].

    Coordinates must lie within ±COORDINATE_LIMIT. Callers check the range of particles.
    """
    shifted = cell_3 + COORDINATE_LIMIT
    key = scene
    for axis in range(3):
        key = (key << COORDINATE_BITS) | shifted[..., axis]
    return key


def of_scene(key: torch.Tensor, scene: int) -> torch.Tensor:
    """Converts keys of scene 0 to keys of another scene."""
    return key + (scene << (3 * COORDINATE_BITS))


def unpack(key: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns scene indices int64 […] and coordinates int64 […, 3]: the inverse of `pack`."""
    mask = (1 << COORDINATE_BITS) - 1
    shifts = (2 * COORDINATE_BITS, COORDINATE_BITS, 0)
    cell_3 = torch.stack([(key >> shift) & mask for shift in shifts], dim=-1) - COORDINATE_LIMIT
    return key >> (3 * COORDINATE_BITS), cell_3


def in_buckets(cell_K3: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Sorts a scene's cells int [K, 3] into hash buckets.

    Returns the limits of the buckets, int32 [B + 1], and in bucket order the cells' keys in scene 0 and the cells'
    numbers, both int64 [K].
    """
    count = len(cell_K3)
    mask = (1 << max(4, math.ceil(math.log2(2 * max(count, 1))))) - 1
    shifted_K3 = cell_K3.long() + COORDINATE_LIMIT
    x, y, z = (shifted_K3 * torch.tensor(HASH_PRIMES, device=shifted_K3.device)).unbind(-1)
    mixed = x ^ y ^ z
    place_K = (mixed ^ mixed >> 15) & mask
    order_K = torch.argsort(place_K, stable=True)
    size_B = torch.bincount(place_K, minlength=mask + 1)
    bucket_B = torch.cat([size_B.new_zeros(1), size_B.cumsum(0)]).int()
    key_K = pack(torch.zeros_like(place_K), cell_K3.long())[order_K]
    return bucket_B, key_K, order_K


def unique(key: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the different keys, sorted, int64 [K], and the index of each element of `key` among them."""
    key_K, index = torch.unique(key, return_inverse=True)
    if is_exporting():
        torch._check(key_K.shape[0] <= LARGEST_EXPORTED)
    return key_K, index


def find(sorted_key_K: torch.Tensor, key: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Looks keys up in a sorted list; returns indices int64 […] (0 where absent) and which keys exist, bool […]."""
    if is_exporting():
        return _find_by_unique(sorted_key_K, key)
    if len(sorted_key_K) == 0:
        return torch.zeros_like(key), torch.zeros_like(key, dtype=torch.bool)
    index = torch.searchsorted(sorted_key_K, key).clamp_(max=len(sorted_key_K) - 1)
    found = sorted_key_K[index] == key
    return index * found, found


def _find_by_unique(sorted_key_K: torch.Tensor, key: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Computes `find` without a search, which ONNX does not have."""
    count = sorted_key_K.shape[0]
    key_U, place = unique(torch.cat([sorted_key_K, key.flatten()]))
    absent_U = torch.full_like(key_U, -1)
    index_U = absent_U.scatter(0, place[:count], torch.arange(count, device=key.device))
    index = index_U[place[count:]].view(key.shape)
    return index.clamp(min=0), index >= 0
