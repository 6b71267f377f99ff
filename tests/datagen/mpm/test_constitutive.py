"""The laws of one particle against a float64 reference that follows the published formulas."""

import numpy as np
import pytest
import taichi as ti

from datagen.mpm.constitutive import solid, water
from datagen.mpm.layout import COUNT, SETTING, VARIANT, constants, lame_parameters, sand_alpha
from datagen.mpm.mls_mpm import respond
from hgn.config import MpmConfig
from hgn.scene.material import SAND, SNOW, WATER

Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.kernel
def update_solids(
    F: Matrices, volume: Scalars, stress: Matrices, stiffness: Scalars, material: ti.i32, constant: Scalars,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), taichi_elements_sand: ti.template(),
):  # fmt: skip
    for n in range(F.shape[0]):
        f, v, s, k = solid(F[n], volume[n], material, constant, 0, counter, 0, True, True, taichi_elements_sand)
        F[n] = f
        volume[n] = v
        stress[n] = s
        stiffness[n] = k


@ti.kernel
def update_water(
    volume: Scalars, expansion: Scalars, pressure: Scalars, constant: Scalars,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), stiffness: Scalars, stiffening: ti.template(),
):  # fmt: skip
    for n in range(volume.shape[0]):
        v, p, k = water(volume[n], expansion[n], constant, 0, counter, 0, stiffening)
        volume[n] = v
        pressure[n] = p
        stiffness[n] = k


@ti.kernel
def update_volumes(
    C: Matrices, volume: Scalars, step: ti.f32, setting: Scalars, constant: Scalars,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), variant: ti.template(),
):  # fmt: skip
    for n in range(volume.shape[0]):
        _, _, _, v, _ = respond(
            C[n], ti.Matrix.zero(ti.f32, 3, 3), ti.Matrix.identity(ti.f32, 3), volume[n], WATER, 0, step, 1.0, 0,
            counter, setting, constant, variant,
        )  # fmt: skip
        volume[n] = v


def scalars(values) -> ti.ScalarNdarray:
    out = ti.ndarray(ti.f32, len(values))
    out.from_numpy(np.asarray(values, np.float32))
    return out


def counters() -> ti.ScalarNdarray:
    out = ti.ndarray(ti.i64, (1, COUNT.length))
    out.fill(0)
    return out


def run(material: int, F_N33: np.ndarray, volume_N: np.ndarray, config: MpmConfig) -> tuple:
    count = len(F_N33)
    F, stress = (ti.Matrix.ndarray(3, 3, ti.f32, count) for _ in range(2))
    F.from_numpy(F_N33.astype(np.float32))
    volume, stiffness, counter = scalars(volume_N), scalars(np.zeros(count)), counters()
    own = config.sand_volume_correction == "taichi_elements"
    update_solids(F, volume, stress, stiffness, material, scalars(constants(config)), counter, own)
    return F.to_numpy(), volume.to_numpy(), stress.to_numpy(), stiffness.to_numpy(), counter.to_numpy()[0]


def deformations(rng: np.random.Generator, count: int, spread: float) -> np.ndarray:
    q = [np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] for _ in range(2)]
    q = [m * np.sign(np.linalg.det(m))[:, None, None] for m in q]
    sigma = np.exp(spread * rng.normal(size=(count, 3)))
    return (q[0] @ (sigma[:, :, None] * np.swapaxes(q[1], 1, 2))).astype(np.float32).astype(float)


def compose(U: np.ndarray, diagonal: np.ndarray, Vt: np.ndarray) -> np.ndarray:
    return U @ (diagonal[:, :, None] * Vt)


def close(got: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    assert np.abs(got - expected).max() <= tolerance * max(np.abs(expected).max(), 1e-30)


@pytest.mark.parametrize("spread", [1e-3, 0.02, 0.2])
def test_snow(spread: float) -> None:
    """Singular values within [0.975, 1.0045], Jp collects the ratio, tau = 2 mu h (F - R) Fᵀ + lambda h J (J - 1)."""
    config, rng = MpmConfig(), np.random.default_rng(1)
    F, Jp = deformations(rng, 500, spread), rng.uniform(0.7, 1.3, 500)
    shear, bulk = lame_parameters(config)
    U, sigma, Vt = np.linalg.svd(F)
    bounded = np.clip(sigma, 0.975, 1.0045)
    new_Jp = Jp * (sigma / bounded).prod(axis=1)
    new_F = compose(U, bounded, Vt)
    h = np.minimum(np.exp(10 * (1 - Jp)), MpmConfig().snow_maximum_hardening)[:, None, None]
    J = bounded.prod(axis=1)[:, None, None]
    stress = 2 * shear * h * (new_F - U @ Vt) @ np.swapaxes(new_F, 1, 2) + bulk * h * J * (J - 1) * np.eye(3)

    got_F, got_Jp, got_stress, stiffness, counter = run(SNOW, F, Jp, config)
    close(got_F, new_F, 2e-6)
    close(got_Jp, new_Jp, 2e-6)
    # the stress is a difference of numbers near 1, so its error is a rounding of 2 mu h
    assert (np.abs(got_stress - stress) / (2 * shear * h)).max() < 2e-6
    new_h = np.minimum(np.exp(10 * (1 - new_Jp)), MpmConfig().snow_maximum_hardening)
    close(stiffness / new_h, np.full(500, 3 * bulk + 2 * shear), 5e-5)
    assert counter[COUNT.hardening_caps] == (np.exp(10 * (1 - new_Jp)) >= MpmConfig().snow_maximum_hardening).sum()


@pytest.mark.parametrize("correction", ["tampubolon", "taichi_elements"])
@pytest.mark.parametrize("law", ["compression", "plane_strain"])
@pytest.mark.parametrize("spread", [1e-3, 0.1])
def test_sand(correction: str, law: str, spread: float) -> None:
    """Drucker-Prager with log strain: the apex in tension, the cone in compression, v_c as each source has it."""
    config = MpmConfig(sand_volume_correction=correction, sand_friction_law=law)
    rng = np.random.default_rng(2)
    F = deformations(rng, 500, spread)
    v_c = np.where(rng.random(500) < 0.5, 0.0, spread * rng.normal(size=500)).astype(np.float32).astype(float)
    shear, bulk = lame_parameters(config)
    U, sigma, Vt = np.linalg.svd(F)
    log_sigma = np.log(sigma)
    strain, new_v_c = np.empty_like(log_sigma), np.empty(500)
    for n in range(500):
        e = log_sigma[n] + (v_c[n] / 3 if correction == "tampubolon" else 0)
        trace = log_sigma[n].sum() + v_c[n]
        deviator = e - trace / 3
        if trace >= 0:
            strain[n] = 0
        else:
            size = np.linalg.norm(deviator)
            gamma = size + (3 * bulk + 2 * shear) / (2 * shear) * trace * sand_alpha(config)
            strain[n] = e - max(gamma, 0) * deviator / size
        if correction == "tampubolon":
            new_v_c[n] = v_c[n] + log_sigma[n].sum() - strain[n].sum()
        else:
            new_v_c[n] = max(trace, 0)
    new_F = compose(U, np.exp(strain), Vt)
    stress = compose(U, 2 * shear * strain + bulk * strain.sum(axis=1, keepdims=True), np.swapaxes(U, 1, 2))

    got_F, got_v_c, got_stress, stiffness, _ = run(SAND, F, v_c, config)
    close(got_F, new_F, 3e-6)
    assert np.abs(got_v_c - new_v_c).max() < 2e-6
    assert np.abs(got_stress - stress).max() < 5e-6 * 2 * shear
    close(stiffness, np.full(500, 3 * bulk + 2 * shear), 1e-6)


def test_friction_slope() -> None:
    """alpha is 0.5036 in compression (Taichi Elements, 45 degrees) and sqrt(2) sin(phi) / 3 in plane strain."""
    assert sand_alpha(MpmConfig()) == pytest.approx(0.5036, abs=1e-4)
    assert sand_alpha(MpmConfig(sand_friction_law="plane_strain")) == pytest.approx(1 / 3)


def test_water() -> None:
    """J <- J (1 + dt tr C), tau = lambda J (J - 1); J is floored and the floors are counted."""
    config = MpmConfig()
    _, bulk = lame_parameters(config)
    J, expansion = np.array([1.0, 0.9, 1.2, 0.15, 1.0]), np.array([1e-3, -0.2, 0.1, -0.5, -3.0])
    volume, pressure, counter = scalars(J), scalars(np.zeros(5)), counters()
    update_water(volume, scalars(expansion), pressure, scalars(constants(config)), counter, scalars(J), False)
    new_J = np.maximum(J * (1 + expansion), 0.1)
    close(volume.to_numpy(), new_J, 1e-6)
    close(pressure.to_numpy(), bulk * new_J * (new_J - 1), 1e-6)
    assert counter.to_numpy()[0, COUNT.water_volume_floors] == 2


def test_volume_updates_of_water() -> None:
    """J *= 1 + dt tr C keeps the volume of turning and purely sheared water; Taichi Elements' determinant does not."""
    rate, step = 50.0, 1e-3
    turning = np.array([[0.0, -rate, 0], [rate, 0, 0], [0, 0, 0]])
    C_N33 = np.stack([turning, np.diag([rate, -rate, 0]), np.diag([rate, rate, -rate])])
    C = ti.Matrix.ndarray(3, 3, ti.f32, len(C_N33))
    C.from_numpy(C_N33.astype(np.float32))
    setting = np.ones(SETTING.length)
    for bit, factor in ((0, 1 + step * np.trace(C_N33, axis1=1, axis2=2)),
                        (VARIANT.taichi_elements_water, np.linalg.det(np.eye(3) + step * C_N33))):  # fmt: skip
        volume = scalars([0.9] * 3)
        update_volumes(
            C, volume, step, scalars(setting), scalars(constants(MpmConfig())), counters(), VARIANT.water + bit
        )
        close(volume.to_numpy(), 0.9 * factor, 1e-6)


def test_stiffening_water() -> None:
    """tau = -J lambda / 7 (J^-7 - 1), its stiffness 3 d(tau) / d(log J): near J = 1 both are those of linear water."""
    config = MpmConfig()
    _, bulk = lame_parameters(config)
    J = np.array([1.0, 0.999, 0.8, 0.5, 1.1])
    volume, pressure, stiffness = scalars(J), scalars(np.zeros(5)), scalars(np.zeros(5))
    update_water(volume, scalars(np.zeros(5)), pressure, scalars(constants(config)), counters(), stiffness, True)
    tau = -J * bulk / 7 * (J**-7.0 - 1)
    close(pressure.to_numpy()[1:], tau[1:], 1e-4)
    close(pressure.to_numpy()[1:2], bulk * J[1:2] * (J[1:2] - 1), 6e-3)
    step = 1e-6
    slope = -bulk / 7 * (((J * (1 + step)) ** -6.0 - J * (1 + step)) - (J**-6.0 - J)) / step
    close(stiffness.to_numpy(), 3 * np.maximum(bulk, slope), 1e-4)


@pytest.mark.parametrize("material", [SAND, SNOW])
def test_elastic_steps_do_not_touch_the_deformation(material: int) -> None:
    """Without plastic flow F is not recomposed: a thousand updates leave every bit as it was."""
    F = np.eye(3) + 1e-3 * np.random.default_rng(3).normal(size=(50, 3, 3)) - 5e-3 * np.eye(3)
    F = F.astype(np.float32)
    volume = np.full(50, 0.0 if material == SAND else 1.0)
    got, got_volume, *_ = run(material, F, volume, MpmConfig())
    assert np.array_equal(got, F)
    assert np.array_equal(got_volume, volume)


@pytest.mark.parametrize("material", [SAND, SNOW])
def test_collapsed_and_inverted_deformations(material: int) -> None:
    """Singular, inverted, huge F: finite results with every singular value at least 0.05, each floor counted."""
    F = np.array([np.zeros((3, 3)), -np.eye(3), np.diag([1.0, 1, -1]), np.diag([1.0, 0, 0]), 1e6 * np.eye(3)])
    got, volume, stress, stiffness, counter = run(
        material, F, np.full(5, 1.0 if material == SNOW else 0.0), MpmConfig()
    )
    for values in (got, volume, stress, stiffness):
        assert np.isfinite(values).all()
    assert np.linalg.svd(got, compute_uv=False).min() > 0.0499
    assert (np.linalg.det(got) > 0).all()
    assert counter[COUNT.singular_value_floors] == 3 + 1 + 1 + 2
    if material == SNOW:
        assert counter[COUNT.plastic_volume_bounds] == 2  # the zero matrix and the huge one
