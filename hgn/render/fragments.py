"""Finds the pixels that triangles cover.

Shape legend: F triangles, R rows of pixels in triangles, S fragments (pixels of triangles), I items.
"""

from collections.abc import Iterator

import numpy as np

from hgn.schema import require

FRAGMENTS_AT_ONCE = 500_000
# largest number of fragments of the obstacles in a picture, and per pixel in a large picture: at most 15 s
MOST_FRAGMENTS, MOST_PER_PIXEL = 40_000_000, 20
ROUNDING = 1e-9  # pixels: neighbouring triangles leave no gap


def fragments(corner_F32: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yields, in parts, the pixels whose centres lie in triangles with the pixel coordinates [F, 3, 2].

    A part has triangle index [S], pixel index (row by row) [S], and barycentric weights [S, 3].
    Raises: ConfigError for too many pixels and rows of triangles.
    """
    after_F32, before_F32 = np.roll(corner_F32, -1, axis=1), np.roll(corner_F32, 1, axis=1)
    edge_F32 = before_F32 - after_F32  # opposite to each corner
    area_F = edge_F32[:, 0, 0] * edge_F32[:, 1, 1] - edge_F32[:, 0, 1] * edge_F32[:, 1, 0]
    area_F1 = np.where(np.abs(area_F) > 1e-9, area_F, np.nan)[:, None]
    # weight of a corner = slope x + the weight in this row at x = 0
    slope_F3, rise_F3 = -edge_F32[:, :, 1] / area_F1, edge_F32[:, :, 0] / area_F1
    y_F3 = np.clip(corner_F32[:, :, 1], 0, height)
    first_F, count = np.floor(y_F3.min(axis=1)).astype(np.int64), 0
    for triangle_R, row_R in _parts(np.where(np.isnan(area_F1[:, 0]), 0, np.ceil(y_F3.max(axis=1)) - first_F)):
        row_R += first_F[triangle_R]
        slope_R3, place_R32 = slope_F3[triangle_R], after_F32[triangle_R]
        weight_R3 = rise_F3[triangle_R] * (row_R[:, None] + 0.5 - place_R32[:, :, 1]) - slope_R3 * place_R32[:, :, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            end_R3 = -weight_R3 / slope_R3 - 0.5
        beyond_R3 = (slope_R3 == 0) & (weight_R3 < 0)
        start_R = np.where(slope_R3 > 0, end_R3, np.where(beyond_R3, np.inf, -np.inf)).max(axis=1)
        stop_R = np.where(slope_R3 < 0, end_R3, np.inf).min(axis=1)
        start_R, stop_R = np.clip((np.ceil(start_R - ROUNDING), np.floor(stop_R + ROUNDING) + 1), 0, width)
        covered_R = np.maximum(stop_R - start_R, 0)
        count += len(row_R) + int(covered_R.sum())
        most, remedy = max(MOST_FRAGMENTS, MOST_PER_PIXEL * width * height), "lower size, or use fewer triangles"
        require(count <= most, "obstacles", f"of triangles that cover at most {most:,} pixels in all", count, remedy)
        for row_S, x_S in _parts(covered_R):
            x_S += start_R[row_S].astype(np.int64)
            weight_S3 = weight_R3[row_S] + slope_R3[row_S] * (x_S[:, None] + 0.5)
            yield triangle_R[row_S], row_R[row_S] * width + x_S, weight_S3


def _parts(count_I: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the index of each item `count` times, and numbers below its count, at most FRAGMENTS_AT_ONCE at a time."""
    count_I = count_I.astype(np.int64)
    end_I = np.cumsum(count_I)
    for first in range(0, int(end_I[-1]) if len(end_I) else 0, FRAGMENTS_AT_ONCE):
        number_S = np.arange(first, min(first + FRAGMENTS_AT_ONCE, int(end_I[-1])))
        index_S = np.searchsorted(end_I, number_S, side="right")
        yield index_S, number_S - (end_I - count_I)[index_S]
