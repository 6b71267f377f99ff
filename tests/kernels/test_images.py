"""Tests the images of scenes in which simulations predict frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from kernels.engines import device
from kernels.test_origins import BACKENDS
from kernels.test_pushforward import let_move, with_parameters
from network.states import network_of, on_device
from training.test_symmetry import ALL_48, doubled, scene_with_obstacles

from hgn.data.batch import make_batch
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.images import IMAGES
from hgn.network.origins import frame_origin
from hgn.runtime.simulator import Simulator
from hgn.scene.material import ELASTIC, MATERIALS
from hgn.training.symmetry import under_symmetries

OWN = {"inputs": "local", "own_physics": ("friction", "parameters", "elastic", "moving"), "materials": MATERIALS}
pytestmark = pytest.mark.usefixtures("large_tiles")
NODES = 1 / 64, 2 / 64  # the walls' planes, whose images are those of the solver's nodes


def symmetry_of(sign):
    """The symmetry of training with these signs."""
    return next(s for s in ALL_48 if s.source == (0, 1, 2) and s.mirrored == tuple(x < 0 for x in sign))


def states(network, signs, move=None):
    """Scenes with obstacles at rest and in motion, friction, parameters and elastic bodies, and their images."""
    episodes = [scene_with_obstacles(i, 9 + i, 20_000) for i in range(len(signs))]
    episodes = [with_parameters(made) for made in episodes]
    episodes[::2] = [replace(made, material_N=np.full_like(made.material_N, ELASTIC)) for made in episodes[::2]]
    if move is not None:
        let_move(move, episodes, [1, 0, 2, 1])
    batch = make_batch([(made, 6) for made in episodes], network.config)
    batch = doubled(batch) if network.decode.second.weight.dtype == torch.float64 else batch
    return batch.state(), under_symmetries(batch, [symmetry_of(sign) for sign in signs]).state()


@pytest.mark.parametrize("distance", [False, True])
def test_a_frame_is_predicted_in_the_image_that_training_shows(distance, monkeypatch):
    """Each scene of a batch, at a frame of its own, has the accelerations of its image with the frame's origin,
    mirrored back. The images are those of training. Horizontal signs cancel over the images. Frame 0 is not mirrored,
    and a given origin neither."""
    assert np.sum(IMAGES, 0).tolist() == [0, len(IMAGES), 0]
    network = network_of(**OWN, obstacle_distance=distance, wall_clearance=NODES)
    frame_S = torch.tensor([0, 1, 7, 10])
    sign_S3 = torch.tensor([IMAGES[k % len(IMAGES)] for k in frame_S]).double()
    state, image = states(network, sign_S3.tolist(), monkeypatch)
    state, origin_S3 = replace(state, frame_S=frame_S), frame_origin(frame_S, network.origin_range, 3).double()
    expected_N3 = sign_S3[state.scene_N] * network(image, origin_S3)
    found_N3, plain_N3 = network(state).detach(), network(state, origin_S3).detach()
    torch.testing.assert_close(found_N3, expected_N3.detach(), rtol=0, atol=1e-12)
    changed_S = torch.stack([(found_N3 - plain_N3)[state.scene_N == s].abs().max() for s in range(len(frame_S))])
    assert (changed_S > 1e-5).tolist() == (sign_S3 < 0).any(1).tolist(), changed_S


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_image_moves_as_the_image_of_the_scene(backend, monkeypatch):
    """If scene and image begin at frames with opposite images, and all frames have the same origin, the image moves as
    the scene, mirrored. With the same images they move differently."""
    monkeypatch.setattr(HierarchicalGraphNetwork, "origin_range", 0.0)
    network = network_of(torch.float32, **OWN, obstacle_distance=True, wall_clearance=NODES)
    network.normaliser.acceleration_std.fill_(0.01)
    state, image = states(network, IMAGES[1:] * 2)
    simulator = Simulator(network.to(device()), 60.0, backend, "fp32")
    paths, sign_3, first_S = [], torch.tensor(IMAGES[1]), torch.tensor([0, 7])
    for start, frame_S in ((state, first_S), (image, first_S + 1), (image, first_S)):
        with simulator.simulation(on_device(replace(start, frame_S=frame_S), device())) as simulation:
            paths.append(simulation.run(4))
    shift_3 = (sign_3 < 0) * (1 - 1 / 64)
    mirrored_TN3 = (sign_3 * torch.from_numpy(paths[0]) + shift_3).numpy()
    np.testing.assert_allclose(paths[1], mirrored_TN3, rtol=0, atol=2e-5)
    assert np.abs(paths[2] - mirrored_TN3).max() > 1e-3


@pytest.mark.parametrize("backend", BACKENDS[1:])
def test_backends_show_the_same_images(backend, monkeypatch):
    """Scenes at frames of their own, with moving obstacles, friction, parameters and elastic bodies, move as on torch,
    and the check of the first output passes in an image."""
    network = network_of(torch.float32, **OWN, obstacle_distance=True, wall_clearance=NODES, obstacle_clearance=5e-4)
    network.normaliser.acceleration_std.fill_(0.01)
    state, _ = states(network, [IMAGES[0]] * 4, monkeypatch)
    state, paths = on_device(replace(state, frame_S=torch.tensor([0, 1, 7, 10])), device()), []
    for name in (backend, "torch"):
        with Simulator(network.to(device()), 60.0, name, "fp32").simulation(state) as simulation:
            paths.append(simulation.run(3))
    np.testing.assert_allclose(paths[0], paths[1], rtol=0, atol=2e-5)
