"""The float32 singular value decomposition against numpy's in float64."""

import numpy as np
import pytest
import taichi as ti

from datagen.mpm.svd import svd3

Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Vectors = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=1)


@ti.kernel
def decompose(A: Matrices, U: Matrices, sigma: Vectors, V: Matrices):
    for n in range(A.shape[0]):
        u, s, v = svd3(A[n])
        U[n] = u
        sigma[n] = s
        V[n] = v


def run(matrix_N33):
    count = len(matrix_N33)
    arrays = [ti.Matrix.ndarray(3, 3, ti.f32, count) for _ in range(3)]
    sigma = ti.Vector.ndarray(3, ti.f32, count)
    arrays[0].from_numpy(matrix_N33.astype(np.float32))
    decompose(arrays[0], arrays[1], sigma, arrays[2])
    return (arrays[1].to_numpy().astype(float), sigma.to_numpy().astype(float), arrays[2].to_numpy().astype(float))


def rotations(rng, count):
    q = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def cases():
    rng = np.random.default_rng(0)
    count = 2000
    left, right = rotations(rng, count), rotations(rng, count)

    def of(sigma_N3):
        return left @ (sigma_N3[:, :, None] * np.swapaxes(right, 1, 2))

    return {
        "random": rng.normal(size=(count, 3, 3)),
        "near a rotation": of(1 + 1e-3 * rng.normal(size=(count, 3))),
        "two equal": of(np.array([1.0, 1.0, 0.9]) * np.ones((count, 1))),
        "near singular": of(np.array([1.0, 0.5, 1e-5]) * np.ones((count, 1))),
        "two near zero": of(np.array([1.0, 1e-6, 1e-7]) * np.ones((count, 1))),
        "rank one": of(np.array([1.0, 0.0, 0.0]) * np.ones((count, 1))),
        "inverted": of(np.array([1.2, 0.8, -0.3]) * np.ones((count, 1))),
        "reflected": of(-rng.uniform(0.5, 1.5, size=(count, 3))),
        "large": 1e12 * rng.normal(size=(count, 3, 3)),
        "small": 1e-12 * rng.normal(size=(count, 3, 3)),
        "exact": np.array([np.zeros((3, 3)), np.eye(3), -np.eye(3), np.ones((3, 3)), np.diag([0.0, 0, 2])]),
    }


@pytest.mark.parametrize("matrix", cases().values(), ids=cases())
def test_decomposition(matrix):
    """A = U diag(sigma) Vᵀ and numpy's singular values to 2e-6 of the largest; U, V are rotations to 2e-6."""
    matrix = matrix.astype(np.float32).astype(float)
    U, sigma, V = run(matrix)
    size = np.maximum(np.abs(matrix).max(axis=(1, 2)), 1e-30)
    for rotation in (U, V):
        assert np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max() < 2e-6
        assert np.abs(np.linalg.det(rotation) - 1).max() < 2e-6
    rebuilt = U @ (sigma[:, :, None] * np.swapaxes(V, 1, 2))
    assert (np.abs(rebuilt - matrix).max(axis=(1, 2)) / size).max() < 2e-6
    truth = np.linalg.svd(matrix, compute_uv=False)
    assert (np.abs(np.abs(sigma) - truth).max(axis=1) / size).max() < 2e-6
    assert (sigma[:, :2] >= -1e-7 * size[:, None]).all()
    clear = np.abs(np.linalg.det(matrix / size[:, None, None])) > 1e-5
    assert (np.sign(sigma[clear, 2]) == np.sign(np.linalg.det(matrix[clear] / size[clear, None, None]))).all()
