"""Draws the scene of all pages: the domain, particles as a cloud of each material, obstacles as meshes.

Shape legend: N particles.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from hgn.render.renderer import BOX_COLOR, BOX_EDGES, OBSTACLE_COLOR, PARTICLE_COLORS, box_corners, to_bytes
from hgn.scene.material import MATERIALS
from hgn.scene.scene import Obstacle
from hgn.scene.shapes import unit_shape
from hgn.schema import Vector

DIAMETER_IN_SPACINGS = 1.2  # the points overlap a little, so that they look like a body
GOLDEN_RATIO = 0.618034  # multiples of it are spread evenly
ROOM_COLOR = (236, 238, 242)
Quaternion = tuple[float, float, float, float]


def quaternion(rotation_33: np.ndarray) -> Quaternion:
    """Returns a rotation as the quaternion (w, x, y, z)."""
    x, y, z, w = Rotation.from_matrix(rotation_33).as_quat()
    return float(w), float(x), float(y), float(z)


class StageView:
    """Draws the scene of a Viser server."""

    def __init__(
        self,
        server: viser.ViserServer,
        domain_size: Vector,
        spacing: float,
        precision: Literal["float16", "float32"] = "float32",
        materials: Sequence[str] = MATERIALS,
        dimensions: int = 3,
    ) -> None:
        """Takes the `spacing` of particles at rest in domain units, and the names of `materials` by index.

        In float16 positions have steps of 2^-12 of the domain. With two dimensions the camera faces the middle plane.
        """
        self.server, self.scene, self.domain_size = server, server.scene, domain_size
        self.scene.set_up_direction("+y")
        self.middle_3 = 0.5 * np.array(domain_size)
        low_3, high_3 = np.zeros(3), np.array(domain_size)
        # the box fills the height and is left of the middle, because the panel is at the right
        size, eye, target = max(domain_size), (0.86, 0.62, 2.0), (0.14, -0.04, -0.06)
        if dimensions == 2:
            low_3[2], high_3[2] = self.middle_3[2] - spacing, self.middle_3[2] + spacing
            size, eye, target = max(domain_size[:2]), (0.0, 0.0, 1.7), (0.0, 0.0, 0.0)
        server.initial_camera.fov = 0.75  # radians
        server.initial_camera.position = tuple(self.middle_3 + size * np.array(eye))
        server.initial_camera.look_at = tuple(self.middle_3 + size * np.array(target))
        # The box is seen from inside, so that its near walls are invisible.
        vertex_V3, triangle_F3, _ = unit_shape("half_box")  # open at the top
        box_V3, box_F3 = np.where(vertex_V3 > 0, high_3, low_3), np.vstack([triangle_F3, [(4, 5, 6), (4, 6, 7)]])
        self.room = self.scene.add_mesh_simple(
            "/room", box_V3, box_F3, color=ROOM_COLOR, side="back", flat_shading=True, cast_shadow=False
        )
        edge_E23 = (low_3 + box_corners((1.0, 1.0, 1.0)) * (high_3 - low_3))[np.array(BOX_EDGES)]
        self.scene.add_line_segments("/edges", edge_E23, BOX_COLOR)
        self.clouds = [
            self.scene.add_point_cloud(
                f"/particles/{name}",
                np.zeros((0, 3), np.float32),
                to_bytes(colour),
                point_size=DIAMETER_IN_SPACINGS * spacing,
                point_shape="circle",
                precision=precision,
                position=tuple(self.middle_3),
            )
            for name, colour in zip(materials, PARTICLE_COLORS, strict=False)
        ]

    def show(self, position_N3: np.ndarray, material_N: np.ndarray) -> None:
        """Shows the particles of a frame in domain units. Omits those that are not finite."""
        there_N = np.isfinite(position_N3).all(axis=1)
        local_N3 = (position_N3 - self.middle_3).astype(np.float32)
        # neighbours differ a little, so that a body has depth
        shade_N1 = 0.7 + 0.3 * np.modf(np.arange(len(position_N3)) * GOLDEN_RATIO)[0][:, None]
        for index, cloud in enumerate(self.clouds):
            mine_N = there_N & (material_N == index)
            if mine_N.any() or len(cloud.points):
                with self.server.atomic():
                    cloud.points = local_N3[mine_N]
                    cloud.colors = to_bytes(PARTICLE_COLORS[index] * shade_N1[mine_N])

    def add_obstacle(self, name: str, mesh: Obstacle, position: Vector, rotation: Quaternion) -> viser.MeshHandle:
        """Adds a mesh, given about its own origin, at a place."""
        return self.scene.add_mesh_simple(
            f"/obstacles/{name}",
            mesh.vertex_V3.astype(np.float32),
            mesh.triangle_F3,
            color=to_bytes(OBSTACLE_COLOR),
            opacity=0.65,
            side="double",
            flat_shading=True,
            position=position,
            wxyz=rotation,
        )
