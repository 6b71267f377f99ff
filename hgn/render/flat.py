"""Draws flat rollouts: their plane, seen straight on, without perspective or shadows.

Shape legend: N particles, P pixels.
"""

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from hgn.render.fragments import fragments
from hgn.render.renderer import (
    BACKGROUND_COLOR,
    BOX_COLOR,
    LINE_COLOR,
    OBSTACLE_COLOR,
    SUPERSAMPLING,
    TALLEST,
    WALL_COLOR,
    Camera,
    Stage,
    to_bytes,
)
from hgn.scene.scene import Obstacle, all_corners
from hgn.schema import Vector


class FlatCamera(Camera):
    """Looks along z at the rectangle [0, domain_size[:2]], y up. All points have the same distance."""

    def __init__(self, domain_size: Vector, size: int) -> None:
        margin = 0.02 * size
        self.axes = np.eye(3)
        self.nearest = 0.0
        most_2 = np.array((size, TALLEST * size)) - 2 * margin
        self.scale = SUPERSAMPLING * float(np.min(most_2 / np.array(domain_size[:2])))
        self.width = SUPERSAMPLING * size
        self.height = SUPERSAMPLING * math.ceil(domain_size[1] * self.scale / SUPERSAMPLING + 2 * margin)
        size_2 = np.array(domain_size[:2]) * self.scale
        self.offset = np.array((self.width, self.height)) / 2 + size_2 * (-0.5, 0.5)

    def project(self, point_N3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return point_N3[:, :2] * (self.scale, -self.scale) + self.offset, np.ones(len(point_N3))


class FlatStage(Stage):
    """Draws frames of particles in a plane. Obstacles are filled areas under the particles."""

    camera_type = FlatCamera

    def place(self, obstacles: Sequence[Obstacle]) -> None:
        camera = self.camera
        picture_P3 = self.room_P3.copy()
        corner_F33 = all_corners(obstacles)
        if len(corner_F33):
            xy, _ = camera.project(corner_F33.reshape(-1, 3))
            for _, covered_S, _ in fragments(xy.reshape(-1, 3, 2), camera.width, camera.height):
                picture_P3[covered_S] = OBSTACLE_COLOR
        self.empty_P3 = to_bytes(picture_P3)

    def _prepare_room(self, domain_size: Vector) -> None:
        camera = self.camera
        self.layer_depth_LP = np.empty((0, camera.width * camera.height), np.float32)  # nothing lies above a particle
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        place_P2 = (np.stack((x.ravel(), y.ravel()), axis=1) - camera.offset) / (camera.scale, -camera.scale)
        box_2 = np.array(domain_size[:2])
        inside_P = ((place_P2 >= 0) & (place_P2 <= box_2)).all(axis=1)
        spacing = box_2.min() / 4
        to_line_P = np.abs(place_P2 - spacing * np.round(place_P2 / spacing)).min(axis=1)
        line_P1 = np.clip(1.5 - to_line_P * camera.scale, 0, 1)[:, None] * 0.6
        wall_P3 = WALL_COLOR * (1 - line_P1) + LINE_COLOR * line_P1
        self.room_P3 = np.tile(BACKGROUND_COLOR, (len(place_P2), 1))
        self.room_P3[inside_P] = wall_P3[inside_P]
        front = Image.new("RGBA", (camera.width, camera.height), (*BOX_COLOR, 0))
        (left, bottom), (right, top) = camera.project(np.array([(0.0, 0.0, 0.0), domain_size]))[0]
        ImageDraw.Draw(front).rectangle((left, top, right, bottom), outline=BOX_COLOR, width=SUPERSAMPLING)
        self.front_box = front.reduce(SUPERSAMPLING)

    def _cast_shadows(self, picture_P3: np.ndarray, position_N3: np.ndarray) -> np.ndarray:
        return np.ones(len(position_N3))
