"""python step_onnx.py MODEL ARRAYS FRAMES OUT: simulates a scene with an ONNX file of hgn.export.

Needs only NumPy and ONNX Runtime.
"""

import sys
import time
from pathlib import Path

import numpy as np
import onnxruntime


def simulate(model: str, arrays: str, frames: int) -> np.ndarray:
    """Positions float32 [frames, N, 3]."""
    session = onnxruntime.InferenceSession(model)
    inputs = {item.name: np.load(Path(arrays) / f"{item.name}.npy") for item in session.get_inputs()}
    positions, poses = [inputs["position"]], inputs.get("moving_pose", [])
    for frame in range(1, frames):
        inputs["frame"] = np.array([frame - 1])  # the number of frames before
        if len(poses):  # those of the frame before and of this frame; at last the obstacles rest
            inputs["moving_pose"] = poses[min(frame - 1, len(poses) - 2) :][:2]
        inputs["position"], inputs["velocity"] = session.run(["next_position", "next_velocity"], inputs)
        if not np.isfinite(inputs["position"]).all():
            raise RuntimeError(f"the simulation diverged at frame {frame}")
        positions.append(inputs["position"])
    return np.stack(positions)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(f"usage: {__doc__}")
    start = time.perf_counter()
    positions = simulate(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    print(f"{1000 * (time.perf_counter() - start) / (len(positions) - 1):.1f} ms a frame, loading included")
    np.save(sys.argv[4], positions)
