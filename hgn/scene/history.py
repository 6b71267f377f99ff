"""The frames before the start of a simulation, in training and in rollouts.

Imported episodes store them. Otherwise they are ballistic motion into the initial state, so a network can start from
any scene.
Shape legend: H history steps, N particles, W = H + 2 window frames.
"""

from collections.abc import Sequence

import numpy as np

from hgn.scene.episode import Episode
from hgn.schema import require


def ballistic_positions(
    position_N3: np.ndarray,
    velocity_N3: np.ndarray,
    gravity: Sequence[float],
    frame_rate_hz: float,
    frame_indices: Sequence[int],
) -> np.ndarray:
    """Returns positions of particles in free flight at the given frames (0 is now, negative is the past).

    Units: domain units, domain units per second (squared). Returns float32 [len(frame_indices), N, 3] from float64.
    """
    time_T11 = np.asarray(frame_indices, np.float64)[:, None, None] / frame_rate_hz
    fall_3 = 0.5 * np.asarray(gravity, np.float64)
    return (position_N3 + velocity_N3 * time_T11 + fall_3 * time_T11**2).astype(np.float32)


def ballistic_velocities(velocity_N3: np.ndarray, gravity_3: np.ndarray, history: int) -> np.ndarray:
    """Returns displacements in the last frames of free flight, newest first, float32 [N, history, 3].

    Units: domain units per frame (squared). Over a frame that ends k frames ago a particle moves by v - (k + 1/2) g.
    With float64, two displacements differ by g up to the rounding of the velocity, not of the position.
    """
    age_H1 = np.arange(history)[:, None] + 0.5
    return (velocity_N3[:, None].astype(np.float64) - age_H1 * np.asarray(gravity_3, np.float64)).astype(np.float32)


def velocity_after(displacement_N3: np.ndarray, gravity_3: np.ndarray) -> np.ndarray:
    """Returns the velocity at the end of a frame of free flight, float64 [N, 3]: the inverse of ballistic_velocities.

    Units: domain units per frame (squared).
    """
    return displacement_N3 + 0.5 * np.asarray(gravity_3, np.float64)


def frames_before(episode: Episode, first: int) -> np.ndarray:
    """Returns the frames `first` (negative) to -1 of an episode, float32 [-first, N, 3].

    Those of imported episodes are stored; others are ballistic. Raises: ConfigError if too few are stored.
    """
    if episode.past_HN3 is not None:
        require_past(episode.past_HN3, -first)
        return np.array(episode.past_HN3[len(episode.past_HN3) + first :])
    return ballistic_positions(
        episode.position_TN3[0], episode.initial_velocity_N3, episode.gravity, episode.frame_rate_hz, range(first, 0)
    )


def require_past(past_HN3: np.ndarray, history: int) -> None:
    """Raises ConfigError if an imported episode has fewer frames before frame 0 than the network's history."""
    remedy = "import the trajectories again with a larger history=…"
    rule = f"at most the {len(past_HN3)} frames that the imported episodes have before their first"
    require(history <= len(past_HN3), "network.velocity_history", rule, history, remedy)


def window(episode: Episode, frame: int, history: int, ahead: int = 1) -> np.ndarray:
    """Returns positions x^{n-H} … x^{n+ahead} around frame n, float32 [H + 1 + ahead, N, 3], a new array.

    0 <= frame <= T - 1 - ahead. Frames before 0 are the ballistic back-extrapolation.
    """
    frame_count = len(episode.position_TN3)
    assert 0 <= frame <= frame_count - 1 - ahead, (frame, frame_count)
    first = frame - history
    stored = np.array(episode.position_TN3[max(first, 0) : frame + 1 + ahead], np.float32)
    if first >= 0:
        return stored
    return np.concatenate([frames_before(episode, first), stored])
