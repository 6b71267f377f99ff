"""Renders particles among translucent obstacles in software: NumPy only, one core, no display.

A `Stage` is set up once for a domain and its obstacles (camera, floor, layers and shadows of obstacles) and then draws
frame after frame. Particles are shaded sphere impostors, drawn from far to near. Each pixel keeps up to LAYERS obstacle
surfaces by depth, and blends them with its particle at the particle's depth. Pictures are drawn at twice their size.

Shape legend: N particles, P pixels, S fragments (pixels of one triangle or sphere), F triangles, L layers.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from PIL import Image, ImageDraw

from hgn.render.fragments import FRAGMENTS_AT_ONCE, fragments
from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.surface import area_vectors
from hgn.schema import Vector

# Colours are sRGB in [0, 1], one for each material in the order of hgn.scene.material.MATERIALS.
MATERIAL_COLORS = np.array([(0.13, 0.45, 0.86), (0.87, 0.60, 0.20), (0.70, 0.81, 0.93), (0.36, 0.66, 0.38)], np.float32)
# These colours repeat for the other materials of imported sets.
_FURTHER = np.array([(0.80, 0.29, 0.53), (0.93, 0.83, 0.30), (0.56, 0.42, 0.75), (0.45, 0.45, 0.48)], np.float32)
_GLOSS = np.array((0.30, 0.06, 0.12, 0.20))
PARTICLE_COLORS = np.concatenate([MATERIAL_COLORS, np.tile(_FURTHER, (64, 1))])[:256]  # index: material of a rollout
PARTICLE_GLOSS = np.concatenate([_GLOSS, np.full(256, 0.12)])[:256]
OBSTACLE_COLOR = np.array((0.60, 0.58, 0.62), np.float32)
BACKGROUND_COLOR = np.array((1.0, 1.0, 1.0), np.float32)
FLOOR_COLOR = np.array((0.89, 0.90, 0.92), np.float32)
WALL_COLOR = np.array((0.955, 0.96, 0.97), np.float32)
LINE_COLOR = np.array((0.80, 0.82, 0.85), np.float32)
BOX_COLOR = (150, 156, 166)

SUPERSAMPLING = 2
TALLEST = 4  # largest height of a picture in its widths
LAYERS = 4
OBSTACLE_OPACITY = 0.34
MOST_SHARED = 64  # corners at a place that a smoothed normal averages; all pairs could take minutes
CREASE_DEG = 35.0  # an edge between two faces is a crease above this angle, and is shaded smoothly below it
AZIMUTH_DEG, ELEVATION_DEG = 28.0, 20.0
CAMERA_DISTANCE = 3.4  # in domain diagonals; a large distance gives a weak perspective
LIGHT = np.array((-0.30, 1.0, 0.28)) / np.linalg.norm((-0.30, 1.0, 0.28))  # points towards the light
SHADOW_CELLS = 160  # number of cells of the floor's shadow map along the longer side


class Camera:
    """Looks in perspective at the box [0, domain_size], y up, and fits it into `size` pixels by TALLEST times as many.

    `width` and `height` are the sizes of the supersampled picture.
    """

    def __init__(self, domain_size: Vector, size: int) -> None:
        azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
        back = np.array(
            (math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation))
        )
        right = np.array((math.cos(azimuth), 0.0, -math.sin(azimuth)))
        self.axes = np.stack((right, np.cross(back, right), back))  # rows: right, up, towards the viewer
        box = np.array(domain_size)
        self.eye = box / 2 + back * CAMERA_DISTANCE * np.linalg.norm(box)
        self.nearest = float(0.3 * CAMERA_DISTANCE * np.linalg.norm(box))  # nearer points are not drawn
        self.scale, self.offset = 1.0, np.zeros(2)
        corner_83 = box_corners(domain_size)
        xy, _ = self.project(corner_83)
        low, high = xy.min(axis=0), xy.max(axis=0)
        margin = 0.02 * size
        self.scale = SUPERSAMPLING * float(np.min((np.array((size, TALLEST * size)) - 2 * margin) / (high - low)))
        self.width = SUPERSAMPLING * size
        self.height = SUPERSAMPLING * math.ceil((high[1] - low[1]) * self.scale / SUPERSAMPLING + 2 * margin)
        self.offset = np.array((self.width, self.height)) / 2 - (low + high) / 2 * self.scale

    def project(self, point_N3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns pixel coordinates [N, 2] (y down) and distances along the view axis [N]."""
        local_N3 = (point_N3 - self.eye) @ self.axes.T
        depth_N = -local_N3[:, 2]
        flat = local_N3[:, :2] / depth_N[:, None] * (1.0, -1.0)
        return flat * self.scale + self.offset, depth_N

    def rays(self) -> np.ndarray:
        """Returns directions through all pixel centres, row by row, not normalised: [P, 3]."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        flat = (np.stack((x.ravel(), y.ravel()), axis=1) - self.offset) / self.scale
        return np.stack((flat[:, 0], -flat[:, 1], np.full(len(flat), -1.0)), axis=1) @ self.axes


class Stage:
    """Draws frames of particles in one domain, among obstacles that stay until a call of `place`.

    domain_size and particle_radius are in domain units. size is the picture's width in pixels; its height follows.
    """

    camera_type: type[Camera] = Camera

    def __init__(
        self, domain_size: Vector, obstacles: Sequence[Obstacle], particle_radius: float, size: int, wall: float = 0.0
    ) -> None:
        """`wall` is the thickness of the domain's walls, which are not drawn: the floor is where particles rest."""
        x, y, z = (side - 2 * wall for side in domain_size)
        self.domain_size, self.wall = (x, y, z), wall
        self.camera = self.camera_type(self.domain_size, size)
        self.radius = particle_radius
        self._prepare_room(self.domain_size)
        self.place(obstacles)

    def place(self, obstacles: Sequence[Obstacle]) -> None:
        """Replaces the obstacles."""
        self._prepare_obstacles([replace(each, vertex_V3=each.vertex_V3 - self.wall) for each in obstacles])
        self._prepare_background()
        self._prepare_box(self.domain_size)

    @property
    def size(self) -> tuple[int, int]:
        """Returns the width and the height of the pictures in pixels."""
        return self.camera.width // SUPERSAMPLING, self.camera.height // SUPERSAMPLING

    def draw(self, position_N3: np.ndarray, material_N: np.ndarray) -> Image.Image:
        """Returns one frame as an RGB picture. Omits particles that are not finite or farther than ten domains away."""
        camera, position_N3 = self.camera, position_N3 - self.wall
        near = (np.abs(position_N3) < 10 * max(self.domain_size)).all(axis=1)
        position_N3, material_N = position_N3[near].astype(np.float64), material_N[near]
        picture_P3 = self.empty_P3.copy()
        lit_N = self._cast_shadows(picture_P3, position_N3)
        self._draw_particles(picture_P3, position_N3, material_N, lit_N)
        picture = Image.fromarray(picture_P3.reshape(camera.height, camera.width, 3), "RGB")
        picture = picture.reduce(SUPERSAMPLING)
        picture.paste(self.front_box, (0, 0), self.front_box)
        return picture

    # the parts that stay the same in every frame without moving obstacles

    def _to_map(self, point_N3: np.ndarray) -> np.ndarray:
        """Returns the place of each point's shadow on the floor, in map cells: [N, 2] as (x, z)."""
        fall_N1 = point_N3[:, 1:2] / LIGHT[1]
        return (point_N3[:, ::2] - fall_N1 * LIGHT[::2]) / self.map_cell

    def _map_index(self, point_N3: np.ndarray) -> np.ndarray:
        """Returns the map cell of each point's shadow, -1 outside the map."""
        column_N, row_N = np.floor(self._to_map(point_N3)).astype(np.int64).T
        rows, columns = self.map_shape
        inside_N = (column_N >= 0) & (column_N < columns) & (row_N >= 0) & (row_N < rows)
        return np.where(inside_N, row_N * columns + column_N, -1)

    def _prepare_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        camera = self.camera
        pixel_count = camera.width * camera.height
        self.layer_depth_LP = np.full((LAYERS, pixel_count), np.inf, np.float32)
        self.layer_shade_LP = np.zeros((LAYERS, pixel_count), np.float32)
        self.map_top = np.full(self.map_shape[0] * self.map_shape[1], -np.inf)
        self.map_obstacle = np.zeros(self.map_shape, np.float32)
        corner_F33 = all_corners(obstacles)
        if not len(corner_F33):
            return
        unit_F3, normal_F33 = smooth_normals(corner_F33)

        xy, depth = camera.project(corner_F33.reshape(-1, 3))
        triangle_P = np.full(pixel_count, -1)
        for triangle_S, pixel_S, weight_S3 in fragments(xy.reshape(-1, 3, 2), camera.width, camera.height):
            # 1 / depth is linear on the screen.
            inverse_S3 = weight_S3 / depth.reshape(-1, 3)[triangle_S]
            inverse_S = inverse_S3.sum(axis=1)
            depth_S = (1 / inverse_S).astype(np.float32)
            order = np.flatnonzero(depth_S < self.layer_depth_LP[-1, pixel_S])
            order = order[np.lexsort((depth_S[order], pixel_S[order]))]
            pixel_S, depth_S, triangle_S = pixel_S[order], depth_S[order], triangle_S[order]
            weight_S3 = inverse_S3[order] / inverse_S[order, None]
            shade_S = self._obstacle_shade(np.einsum("sk,skd->sd", weight_S3, normal_F33[triangle_S]))
            rank_S = np.arange(len(pixel_S)) - np.searchsorted(pixel_S, pixel_S)
            at = pixel_S[rank_S == 0]
            triangle_P[at] = np.where(
                depth_S[rank_S == 0] < self.layer_depth_LP[0, at], triangle_S[rank_S == 0], triangle_P[at]
            )
            # the nearest of the layers so far and of these
            depth_AK = np.concatenate([self.layer_depth_LP[:, at].T, np.full((len(at), LAYERS), np.inf, np.float32)], 1)
            shade_AK = np.concatenate([self.layer_shade_LP[:, at].T, np.zeros((len(at), LAYERS), np.float32)], 1)
            shown = rank_S < LAYERS
            place = np.cumsum(rank_S == 0)[shown] - 1, LAYERS + rank_S[shown]
            depth_AK[place], shade_AK[place] = depth_S[shown], shade_S[shown]
            nearest_AL = np.argsort(depth_AK, axis=1, kind="stable")[:, :LAYERS]
            self.layer_depth_LP[:, at] = np.take_along_axis(depth_AK, nearest_AL, axis=1).T
            self.layer_shade_LP[:, at] = np.take_along_axis(shade_AK, nearest_AL, axis=1).T
        self._darken_outlines(triangle_P, unit_F3)

        rows, columns = self.map_shape
        xy = self._to_map(corner_F33.reshape(-1, 3)).reshape(-1, 3, 2)
        for triangle_S, cell_S, weight_S3 in fragments(xy, columns, rows):
            height_S = np.einsum("sk,sk->s", weight_S3, corner_F33[triangle_S, :, 1])
            np.maximum.at(self.map_top, cell_S, height_S)
        self.map_obstacle = _blurred(np.isfinite(self.map_top).astype(np.float32).reshape(self.map_shape), 1.6)

    def _obstacle_shade(self, normal_S3: np.ndarray) -> np.ndarray:
        facing_S3 = normal_S3 / np.maximum(np.linalg.norm(normal_S3, axis=1, keepdims=True), 1e-12)
        # Sheets and unoriented meshes have no outer side, so the side towards the camera is lit.
        away_S = facing_S3 @ self.camera.axes[2] < 0
        facing_S3 = np.where(away_S[:, None], -facing_S3, facing_S3)
        return (0.62 + 0.55 * np.clip(facing_S3 @ LIGHT, -0.35, 1.0)).astype(np.float32)

    def _darken_outlines(self, triangle_P: np.ndarray, unit_F3: np.ndarray) -> None:
        """Draws lines where the nearest obstacle surface jumps or has a crease, to show the shapes of bodies.

        triangle_P is the nearest triangle of each pixel, -1 for none. unit_F3 are the normals of the triangles.
        """
        shape = (self.camera.height, self.camera.width)
        depth = np.where(triangle_P >= 0, self.layer_depth_LP[0], 1e3).reshape(shape)
        normal = unit_F3.astype(np.float32)[triangle_P].reshape(*shape, 3)
        edge = np.zeros(shape, bool)
        for axis in (0, 1):
            first, second = (
                tuple(part if a == axis else slice(None) for a in (0, 1)) for part in (slice(None, -1), slice(1, None))
            )
            crease = np.abs((normal[first] * normal[second]).sum(axis=-1)) < math.cos(math.radians(CREASE_DEG))
            edge[first] |= crease
            # A jump has a large second difference. First differences are large everywhere on a steep plane.
            inner = tuple(slice(1, -1) if a == axis else slice(None) for a in (0, 1))
            edge[inner] |= np.abs(np.diff(depth, 2, axis=axis)) > 6.0 / self.camera.scale * depth.min()
        self.layer_shade_LP[0, edge.ravel() & (triangle_P >= 0)] *= 0.45

    def _prepare_room(self, domain_size: Vector) -> None:
        """Draws floor and walls, without obstacles and shadows."""
        self.map_cell = max(domain_size[0], domain_size[2]) / SHADOW_CELLS
        # The light is slanted, so shadows of high particles may fall beside the floor. The map omits these.
        self.map_shape = tuple(math.ceil(domain_size[axis] / self.map_cell) for axis in (2, 0))
        camera = self.camera
        ray_P3 = camera.rays()
        color_P3 = np.tile(BACKGROUND_COLOR, (len(ray_P3), 1))
        box = np.array(domain_size)
        spacing = box.min() / 4
        pixel_width = camera.axes[2] @ (camera.eye - box / 2) / camera.scale
        self.floor_P = np.empty(0, np.int64)
        for axis, color in ((0, WALL_COLOR), (2, WALL_COLOR), (1, FLOOR_COLOR)):
            hit_P3 = camera.eye - ray_P3 * (camera.eye[axis] / ray_P3[:, axis])[:, None]
            others = [a for a in range(3) if a != axis]
            inside_P = ((hit_P3[:, others] >= 0) & (hit_P3[:, others] <= box[others])).all(axis=1)
            pixel_P = np.flatnonzero(inside_P)
            hit = hit_P3[pixel_P][:, others]
            to_line = np.abs(hit - spacing * np.round(hit / spacing)).min(axis=1)
            line = np.clip(1.5 - to_line / pixel_width, 0, 1)[:, None] * 0.6
            color_P3[pixel_P] = color * (1 - line) + LINE_COLOR * line
            if axis == 1:
                self.floor_P = pixel_P
                floor_hit = hit
        self.room_P3 = color_P3.astype(np.float32)
        rows, columns = self.map_shape
        column = np.clip((floor_hit[:, 0] / self.map_cell).astype(np.int64), 0, columns - 1)
        row = np.clip((floor_hit[:, 1] / self.map_cell).astype(np.int64), 0, rows - 1)
        self.floor_cell_P = row * columns + column

    def _prepare_background(self) -> None:
        """Draws the room behind the obstacles' layers, with the obstacles' shadow on the floor."""
        pixel_count = len(self.room_P3)
        through_P = np.ones(pixel_count, np.float32)
        gathered_P3 = np.zeros((pixel_count, 3), np.float32)
        for layer in range(LAYERS):
            present_P = np.isfinite(self.layer_depth_LP[layer])
            gathered_P3 += (present_P * through_P * OBSTACLE_OPACITY * self.layer_shade_LP[layer])[:, None] * (
                OBSTACLE_COLOR
            )
            through_P *= np.where(present_P, np.float32(1 - OBSTACLE_OPACITY), np.float32(1))
        self.background_P3 = self.room_P3.copy()
        obstacle_shadow = self.map_obstacle.ravel()[self.floor_cell_P]
        self.background_P3[self.floor_P] *= (1 - 0.20 * obstacle_shadow)[:, None]
        self.empty_P3 = to_bytes(gathered_P3 + through_P[:, None] * self.background_P3)
        # The amount by which a pixel of the floor darkens if the floor becomes black.
        self.floor_share_P3 = 255 * through_P[self.floor_P, None] * self.background_P3[self.floor_P]

    def _prepare_box(self, domain_size: Vector) -> None:
        """Prepares the box's edges: far ones under everything, near ones over the finished picture."""
        camera = self.camera
        corner_83 = box_corners(domain_size)
        xy, _ = camera.project(corner_83)
        front = Image.new("RGBA", (camera.width, camera.height), (*BOX_COLOR, 0))
        back = Image.fromarray(self.empty_P3.reshape(camera.height, camera.width, 3), "RGB")
        over, under = ImageDraw.Draw(front), ImageDraw.Draw(back)
        for a, b in BOX_EDGES:
            # Corner 7 is nearest to the eye. Only its three edges lie in front of all particles.
            near = a.bit_count() == 2
            target, color = (over, (*BOX_COLOR, 120)) if near else (under, BOX_COLOR)
            target.line([tuple(xy[a]), tuple(xy[b])], fill=color, width=SUPERSAMPLING)
        self.front_box = front.reduce(SUPERSAMPLING)
        self.empty_P3 = np.asarray(back).reshape(-1, 3).copy()

    # the parts that change with every frame

    def _cast_shadows(self, picture_P3: np.ndarray, position_N3: np.ndarray) -> np.ndarray:
        """Darkens the floor below particles. Returns the fraction of light that each particle gets."""
        cell_N = self._map_index(position_N3)
        inside_N = cell_N >= 0
        count = np.bincount(cell_N[inside_N], minlength=len(self.map_top)).reshape(self.map_shape)
        area = (self.map_cell / (2 * self.radius)) ** 2  # number of particles that fill one map cell
        sigma = max(1.5, 1.5 * self.radius / self.map_cell)
        cover = _blurred(np.minimum(count / max(area, 1.0), 2.0).astype(np.float32), sigma)
        if area < 1:
            cover /= area
        cover = 0.38 * (1 - np.exp(-1.6 * cover)).ravel()
        loss_P = cover[self.floor_cell_P]
        dark = np.flatnonzero(loss_P > 0.004)
        loss = (self.floor_share_P3[dark] * loss_P[dark, None]).astype(np.uint8)
        picture_P3[self.floor_P[dark]] -= np.minimum(loss, picture_P3[self.floor_P[dark]])

        top = self.map_top.copy()
        np.maximum.at(top, cell_N[inside_N], position_N3[inside_N, 1])
        top = np.where(np.isfinite(top), top, 0.0).reshape(self.map_shape)
        top = _blurred(top, sigma).ravel()
        above_N = np.where(inside_N, top[cell_N] - position_N3[:, 1], 0.0)
        shadow_N = np.clip((above_N - self.radius) / (10 * self.radius), 0.0, 1.0)
        return 1 - 0.17 * shadow_N

    def _draw_particles(
        self, picture_P3: np.ndarray, position_N3: np.ndarray, material_N: np.ndarray, lit_N: np.ndarray
    ) -> None:
        camera = self.camera
        xy_N2, depth_N = camera.project(position_N3)
        order = np.argsort(-depth_N)  # far first, because later particles overwrite earlier ones
        order = order[depth_N[order] > camera.nearest]
        xy_N2, depth_N = xy_N2[order].astype(np.float32), depth_N[order].astype(np.float32)
        radius_N = np.maximum(self.radius * camera.scale / depth_N, 1.1 * SUPERSAMPLING).astype(np.float32)
        reach = math.ceil(float(radius_N.max())) + 1 if len(order) else 0
        span = np.arange(-reach, reach + 1)
        offset_O2 = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
        offset_O2 = offset_O2[(np.maximum(np.abs(offset_O2) - 1, 0) ** 2).sum(axis=1) <= reach**2]

        winner_P = np.full(camera.width * camera.height, -1, np.int32)
        at_once = max(1, FRAGMENTS_AT_ONCE // len(offset_O2))
        for first in range(0, len(order), at_once):
            batch = slice(first, first + at_once)
            center = np.floor(xy_N2[batch]).astype(np.int32)
            x = center[:, None, 0] + offset_O2[:, 0].astype(np.int32)
            y = center[:, None, 1] + offset_O2[:, 1].astype(np.int32)
            away = (x + np.float32(0.5) - xy_N2[batch, None, 0]) ** 2
            away += (y + np.float32(0.5) - xy_N2[batch, None, 1]) ** 2
            drawn = away < radius_N[batch, None] ** 2
            drawn &= (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            index = np.broadcast_to(np.arange(len(center), dtype=np.int32)[:, None] + first, x.shape)
            winner_P[(y * camera.width + x)[drawn]] = index[drawn]

        pixel_S = np.flatnonzero(winner_P >= 0)
        if not len(pixel_S):
            return
        particle_S = winner_P[pixel_S]
        x_S = (pixel_S % camera.width + 0.5 - xy_N2[particle_S, 0]) / radius_N[particle_S]
        y_S = (xy_N2[particle_S, 1] - (pixel_S // camera.width) - 0.5) / radius_N[particle_S]
        z_S = np.sqrt(np.maximum(1 - x_S**2 - y_S**2, 0))
        light = camera.axes @ LIGHT
        lambert_S = np.clip(x_S * light[0] + y_S * light[1] + z_S * light[2], 0, 1)
        half = light + np.array((0.0, 0.0, 1.0))
        half /= np.linalg.norm(half)
        gloss_S = np.clip(x_S * half[0] + y_S * half[1] + z_S * half[2], 0, 1) ** 24
        material_S = material_N[order][particle_S]
        lit_S = lit_N[order][particle_S]
        shade_S = (0.76 + 0.38 * lambert_S) * lit_S * (0.80 + 0.20 * z_S)
        shine_S = PARTICLE_GLOSS[material_S] * gloss_S * lit_S
        color_S3 = PARTICLE_COLORS[material_S] * shade_S[:, None].astype(np.float32)
        color_S3 += shine_S[:, None].astype(np.float32)

        depth_S = depth_N[particle_S]
        for layer in reversed(range(len(self.layer_depth_LP))):
            before_S = self.layer_depth_LP[layer, pixel_S] < depth_S
            covered = np.flatnonzero(before_S)
            if len(covered):
                shade = self.layer_shade_LP[layer, pixel_S[covered], None]
                color_S3[covered] *= 1 - OBSTACLE_OPACITY
                color_S3[covered] += OBSTACLE_OPACITY * shade * OBSTACLE_COLOR
        picture_P3[pixel_S] = to_bytes(color_S3)


# An edge joins two of the box's corners. The second corner has one more coordinate at its far end, see box_corners.
BOX_EDGES = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]


def box_corners(domain_size: Vector) -> np.ndarray:
    """Returns the corners of [0, domain_size], [8, 3]. Bit `axis` of i is set if corner i is at the axis's far end."""
    return np.array([[(i >> axis) & 1 for axis in range(3)] for i in range(8)]) * np.array(domain_size)


def to_bytes(color: np.ndarray) -> np.ndarray:
    """Returns colours in [0, 1] as uint8, clipped."""
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)


def smooth_normals(corner_F33: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns unit normals of triangles, float64 [F, 3], and smoothed normals at their corners, float64 [F, 3, 3].

    A triangle without area has a zero normal. The smoothed normals average over neighbours that bend less than a
    crease. Corners at the same place count as shared, so that meshes need not share vertices.
    """
    area_F3 = area_vectors(corner_F33)
    unit_F3 = area_F3 / np.maximum(np.linalg.norm(area_F3, axis=1, keepdims=True), 1e-30)
    _, place = np.unique(np.round(corner_F33.reshape(-1, 3), 9), axis=0, return_inverse=True)
    order = np.argsort(place.ravel(), kind="stable")
    start = np.flatnonzero(np.diff(place.ravel()[order], prepend=-1))
    size = np.diff(np.append(start, len(order)))
    smooth = np.zeros((len(order), 3))
    # Each pass pairs every corner with another one at the same place, until all pairs at a place are compared. In a
    # place of more than MOST_SHARED corners an average contains that many of them.
    largest = min(int(size.max()), MOST_SHARED)
    first_of = np.repeat(start, size)
    size_of = np.repeat(size, size)
    rank = np.arange(len(order)) - first_of
    for shift in range(largest):
        have = size_of > shift
        mine = order[have]
        other = order[first_of[have] + (rank[have] + shift) % size_of[have]]
        close = (unit_F3[mine // 3] * unit_F3[other // 3]).sum(axis=1) >= math.cos(math.radians(CREASE_DEG))
        smooth[mine[close]] += area_F3[other[close] // 3]
    return unit_F3, smooth.reshape(-1, 3, 3)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    from scipy.ndimage import gaussian_filter  # imported here, because SciPy takes half a second to import

    return np.asarray(gaussian_filter(image, sigma))
