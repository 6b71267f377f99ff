"""The laws of one particle against a float64 reference that follows the published formulas."""

import dataclasses
from collections import namedtuple

import numpy as np
import pytest
import taichi as ti

from datagen.mpm import layout
from datagen.mpm.constitutive import solid, water
from datagen.mpm.layout import (
    COUNT,
    SETTING,
    SOLID_VARIANTS,
    VARIANT,
    constants,
    is_only_solid,
    lame_parameters,
    sand_alpha,
)
from datagen.mpm.mls_mpm import respond
from hgn.config import MpmConfig
from hgn.scene.material import ELASTIC, SAND, SNOW, WATER
from hgn.solver_method import METHODS

Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
STEP_S = 1e-3
CAP = METHODS["corrected"].snow_maximum_hardening

RespondArrays = namedtuple("RespondArrays", ["setting", "law", "counter", "variant"])


@ti.kernel
def update_solids(
    F: Matrices, volume: Scalars, stress: Matrices, stiffness: Scalars, material: ti.i32, constant: Scalars,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), variant: ti.template(),
):  # fmt: skip
    for n in range(F.shape[0]):
        f, v, s, k = solid(F[n], volume[n], material, constant, 0, counter, 0, variant, STEP_S)
        F[n] = f
        volume[n] = v
        stress[n] = s
        stiffness[n] = k


@ti.kernel
def update_water(
    volume: Scalars, expansion: Scalars, pressure: Scalars, constant: Scalars,
    counter: ti.types.ndarray(dtype=ti.i64, ndim=2), stiffness: Scalars,
):  # fmt: skip
    for n in range(volume.shape[0]):
        v, p, k = water(volume[n], expansion[n], constant, 0, counter, 0)
        volume[n] = v
        pressure[n] = p
        stiffness[n] = k


@ti.kernel
def move_water(
    C: Matrices, response: Matrices, stiffness: Scalars, volume: Scalars, step: ti.f32, setting: Scalars,
    constant: Scalars, counter: ti.types.ndarray(dtype=ti.i64, ndim=2), variant: ti.template(),
):  # fmt: skip
    for n in range(volume.shape[0]):
        arrays = ti.static(RespondArrays(setting, constant, counter, variant))
        A, _, _, v, k = respond(
            C[n], ti.Matrix.zero(ti.f32, 3, 3), ti.Matrix.identity(ti.f32, 3), volume[n], WATER, 0, step, 0, arrays
        )
        response[n] = A
        volume[n] = v
        stiffness[n] = k


def scalars(values):
    out = ti.ndarray(ti.f32, len(values))
    out.from_numpy(np.asarray(values, np.float32))
    return out


def matrices(values):
    out = ti.Matrix.ndarray(3, 3, ti.f32, len(values))
    out.from_numpy(np.asarray(values, np.float32))
    return out


def counters():
    out = ti.ndarray(ti.i64, (1, COUNT.length))
    out.fill(0)
    return out


def run(material, F_N33, volume_N, config):
    F, stress = matrices(F_N33), matrices(0 * F_N33)
    volume, stiffness, counter = scalars(volume_N), scalars(0 * volume_N), counters()
    variant = SOLID_VARIANTS
    variant += VARIANT.taichi_elements * (config.method == "taichi_elements")
    variant += VARIANT.rate_of_sand * (config.sand_grain_diameter_m > 0)
    update_solids(F, volume, stress, stiffness, material, scalars(constants(config)), counter, variant)
    return F.to_numpy(), volume.to_numpy(), stress.to_numpy(), stiffness.to_numpy(), counter.to_numpy()[0]


def moved_water(C_N33, volume_N, step, variant=0, config=None, dx=1.0):
    """The stress of particles of water, as they give it, their volumes behind a step, and stiffness."""
    setting = np.ones(SETTING.length)
    setting[SETTING.inverse_cell_size] = 1 / dx
    response, stiffness, volume = matrices(0 * C_N33), scalars(0 * volume_N), scalars(volume_N)
    law = scalars(constants(config or MpmConfig()))
    move_water(
        matrices(C_N33), response, stiffness, volume, step, scalars(setting), law, counters(), VARIANT.water + variant
    )
    return response.to_numpy(), volume.to_numpy(), stiffness.to_numpy()


def deformations(rng, count, spread):
    q = [np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] for _ in range(2)]
    q = [m * np.sign(np.linalg.det(m))[:, None, None] for m in q]
    sigma = np.exp(spread * rng.normal(size=(count, 3)))
    return (q[0] @ (sigma[:, :, None] * np.swapaxes(q[1], 1, 2))).astype(np.float32).astype(float)


def compose(U, diagonal, Vt):
    return U @ (diagonal[:, :, None] * Vt)


def close(got, expected, tolerance):
    assert np.abs(got - expected).max() <= tolerance * max(np.abs(expected).max(), 1e-30)


@pytest.mark.parametrize("spread", [1e-3, 0.02, 0.2])
def test_snow(spread):
    """Singular values within [0.975, 1.0045], Jp collects the ratio, tau = 2 mu h (F - R) Fᵀ + lambda h J (J - 1)."""
    config, rng = MpmConfig(), np.random.default_rng(1)
    F, Jp = deformations(rng, 500, spread), rng.uniform(0.7, 1.3, 500)
    shear, bulk = lame_parameters(config)
    U, sigma, Vt = np.linalg.svd(F)
    bounded = np.clip(sigma, 0.975, 1.0045)
    new_Jp = Jp * (sigma / bounded).prod(axis=1)
    new_F = compose(U, bounded, Vt)
    h = np.minimum(np.exp(10 * (1 - Jp)), CAP)[:, None, None]
    J = bounded.prod(axis=1)[:, None, None]
    stress = 2 * shear * h * (new_F - U @ Vt) @ np.swapaxes(new_F, 1, 2) + bulk * h * J * (J - 1) * np.eye(3)

    got_F, got_Jp, got_stress, stiffness, counter = run(SNOW, F, Jp, config)
    close(got_F, new_F, 2e-6)
    close(got_Jp, new_Jp, 2e-6)
    # the stress is a difference of numbers near 1, so its error is a rounding of 2 mu h
    assert (np.abs(got_stress - stress) / (2 * shear * h)).max() < 2e-6
    new_h = np.minimum(np.exp(10 * (1 - new_Jp)), CAP)
    close(stiffness / new_h, np.full(500, 3 * bulk + 2 * shear), 5e-5)
    assert counter[COUNT.hardening_caps] == (np.exp(10 * (1 - new_Jp)) >= CAP).sum()


@pytest.mark.parametrize("spread", [1e-3, 0.3])
def test_elastic_solid(spread):
    """tau = 2 mu (F - R) Fᵀ + lambda J (J - 1) at any stretch, F as it was; the stiffness that the step follows is at
    least every d(tau) / d(log sigma) in turn, with that of the volume three times.
    """
    config = MpmConfig()
    F = deformations(np.random.default_rng(4), 500, spread)
    shear, bulk = lame_parameters(config)
    U, sigma, Vt = np.linalg.svd(F)
    J = sigma.prod(axis=1)
    stress = 2 * shear * (F - U @ Vt) @ np.swapaxes(F, 1, 2) + (bulk * J * (J - 1))[:, None, None] * np.eye(3)

    got_F, volume, got_stress, stiffness, counter = run(ELASTIC, F, np.ones(500), config)
    assert np.array_equal(got_F, F.astype(np.float32)) and (volume == 1).all() and not counter.any()
    assert np.abs(got_stress - stress).max() < 3e-6 * (2 * shear + np.abs(stress).max())
    steepest = 3 * bulk * J * (2 * J - 1) + 2 * shear * (sigma * (2 * sigma - 1)).max(axis=1)
    assert (stiffness > 0.99999 * np.maximum(steepest, 3 * bulk + 2 * shear)).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("spread", [1e-3, 0.1])
def test_sand(method, spread):
    """Log strain: no stress in tension; in compression Mohr-Coulomb's limit or Taichi Elements' cone, with v_c of each
    method."""
    config = MpmConfig(method=method, sand_grain_diameter_m=0.0)
    rng = np.random.default_rng(2)
    F = deformations(rng, 500, spread)
    v_c = np.where(rng.random(500) < 0.5, 0.0, spread * rng.normal(size=500)).astype(np.float32).astype(float)
    shear, bulk = lame_parameters(config)
    U, sigma, Vt = np.linalg.svd(F)
    log_sigma = np.log(sigma)
    strain, new_v_c = np.empty_like(log_sigma), np.empty(500)
    for n in range(500):
        e = log_sigma[n] + (v_c[n] / 3 if method == "corrected" else 0)
        trace = log_sigma[n].sum() + v_c[n]
        deviator = e - trace / 3
        if trace >= 0:
            strain[n] = 0
        else:
            size = np.linalg.norm(deviator)
            pressure = -(3 * bulk + 2 * shear) * trace / 3
            if method == "corrected":  # s1 - s3 = (s1 + s3) sin phi, s = p - r d / |d|
                d, sine = np.sort(deviator) / size, np.sin(np.deg2rad(config.sand_friction_angle_deg))
                largest = 2 * pressure * sine / (d[2] - d[0] + (d[0] + d[2]) * sine)
            else:
                largest = 3 * sand_alpha(config) * pressure
            strain[n] = e - max(1 - largest / (2 * shear * size), 0) * deviator
        if method == "corrected":
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


def test_friction_slope():
    """Taichi Elements' cone of 45 degrees has the slope 0.5036."""
    assert sand_alpha(MpmConfig(sand_friction_angle_deg=45.0)) == pytest.approx(0.5036, abs=1e-4)


def test_water():
    """J <- J (1 + dt tr C), tau = lambda J (J - 1); J is floored and the floors are counted."""
    config = MpmConfig()
    _, bulk = lame_parameters(config)
    J, expansion = np.array([1.0, 0.9, 1.2, 0.15, 1.0]), np.array([1e-3, -0.2, 0.1, -0.5, -3.0])
    volume, pressure, counter = scalars(J), scalars(np.zeros(5)), counters()
    update_water(volume, scalars(expansion), pressure, scalars(constants(config)), counter, scalars(J))
    new_J = np.maximum(J * (1 + expansion), 0.1)
    close(volume.to_numpy(), new_J, 1e-6)
    close(pressure.to_numpy(), bulk * new_J * (new_J - 1), 1e-6)
    assert counter.to_numpy()[0, COUNT.water_volume_floors] == 2


def test_volume_updates_of_water():
    """J *= 1 + dt tr C keeps the volume of turning and purely sheared water; Taichi Elements' determinant does not."""
    rate, step = 50.0, 1e-3
    turning = np.array([[0.0, -rate, 0], [rate, 0, 0], [0, 0, 0]])
    C_N33 = np.stack([turning, np.diag([rate, -rate, 0]), np.diag([rate, rate, -rate])])
    for bit, factor in ((0, 1 + step * np.trace(C_N33, axis1=1, axis2=2)),
                        (VARIANT.taichi_elements, np.linalg.det(np.eye(3) + step * C_N33))):  # fmt: skip
        _, volume_N, _ = moved_water(C_N33, np.full(3, 0.9), step, bit)
        close(volume_N, 0.9 * factor, 1e-6)


def test_water_without_tension():
    """Stretched water bears the share of the tension that it is given, none with 0; J grows, and pressure is back as
    soon as J is below 1. Water under pressure does not know of it.
    """
    J = np.array([1.2, 1.001, 1.0, 0.9])
    pressure = {}
    for share in (1.0, 0.5, 0.0):
        volume, out = scalars(J), scalars(np.zeros(4))
        law = scalars(constants(MpmConfig(water_tension=share)))
        update_water(volume, scalars(np.zeros(4)), out, law, counters(), scalars(J))
        close(volume.to_numpy(), J, 1e-6)
        pressure[share] = out.to_numpy()
    assert (pressure[1.0][:2] > 0).all()
    assert (pressure[0.0][:2] == 0).all()
    assert pressure[0.5][:2] == pytest.approx(0.5 * pressure[1.0][:2])
    assert (pressure[0.0][2:] == pressure[1.0][2:]).all()


def test_viscous_stress():
    """Sheared at a rate, viscous water bears the rate times its viscosity across the shear, and no other stress."""
    rate, step, viscosity, dx = 50.0, 1e-4, 3.0, 0.1
    C_N33 = np.array([[[0.0, rate, 0], [0, 0, 0], [0, 0, 0]]])
    config = MpmConfig(water_viscosity_pa_s=viscosity)
    response_N33, _, stiffness_N = moved_water(C_N33, np.ones(1), step, config=config, dx=dx)
    stress = response_N33[0] / (-4 / dx**2 / config.density_kg_m3)
    expected = np.zeros((3, 3))
    expected[0, 1] = expected[1, 0] = viscosity * rate
    assert stress == pytest.approx(expected, rel=1e-5, abs=0.05)
    bulk = lame_parameters(config)[1]
    rough = np.sqrt(3 * bulk / 1000) + 4 * viscosity / (1000 * dx)
    assert stiffness_N[0] == pytest.approx(rough**2, rel=1e-4)


def test_a_new_solid_is_told_from_the_others(monkeypatch):
    """A kernel leaves out the look at a particle's material only where there is one solid, a solid to come included."""
    assert is_only_solid(VARIANT.sand | VARIANT.water | VARIANT.contact, VARIANT.sand)
    assert not is_only_solid(VARIANT.sand | VARIANT.snow, VARIANT.sand)
    clay = 2 * VARIANT.parts
    monkeypatch.setattr(layout, "SOLID_VARIANTS", SOLID_VARIANTS | clay)
    assert not is_only_solid(VARIANT.sand | clay, VARIANT.sand)


@pytest.mark.parametrize("material", [SAND, SNOW, ELASTIC])
def test_elastic_steps_do_not_touch_the_deformation(material):
    """Without plastic flow F is not recomposed: a thousand updates leave every bit as it was."""
    F = np.eye(3) + 1e-3 * np.random.default_rng(3).normal(size=(50, 3, 3)) - 5e-3 * np.eye(3)
    F = F.astype(np.float32)
    volume = np.full(50, 0.0 if material == SAND else 1.0)
    got, got_volume, *_ = run(material, F, volume, MpmConfig())
    assert np.array_equal(got, F)
    assert np.array_equal(got_volume, volume)


@pytest.mark.parametrize("material", [SAND, SNOW, ELASTIC])
def test_collapsed_and_inverted_deformations(material):
    """Singular, inverted, huge F: finite results with every singular value at least 0.05, each floor counted."""
    F = np.array([np.zeros((3, 3)), -np.eye(3), np.diag([1.0, 1, -1]), np.diag([1.0, 0, 0]), 1e6 * np.eye(3)])
    got, volume, stress, stiffness, counter = run(
        material, F, np.full(5, 0.0 if material == SAND else 1.0), MpmConfig()
    )
    for values in (got, volume, stress, stiffness):
        assert np.isfinite(values).all()
    assert np.linalg.svd(got, compute_uv=False).min() > 0.0499
    assert (np.linalg.det(got) > 0).all()
    assert counter[COUNT.singular_value_floors] == 3 + 1 + 1 + 2
    if material == SNOW:
        assert counter[COUNT.plastic_volume_bounds] == 2  # the zero matrix and the huge one


class Element:
    """One particle that is strained step by step, as an element of soil is in a laboratory."""

    def __init__(self, material, config):
        self.material, self.config = material, config
        self.F = np.eye(3)
        self.volume = 0.0 if material == SAND else 1.0

    def answer(self, gradient):
        """F, Kirchhoff stress and volume scalar after a step of the gradient (times its time), not yet taken."""
        F, volume, stress, *_ = run(
            self.material, ((np.eye(3) + gradient) @ self.F)[None], np.array([self.volume]), self.config
        )
        return F[0].astype(float), stress[0].astype(float), float(volume[0])

    def step(self, gradient):
        self.F, stress, self.volume = self.answer(gradient)
        return stress

    def step_against(self, gradient, direction, axis, pressure):
        """A step with as much of `direction` as keeps the stress along `axis` at -pressure (secant method)."""
        tries = [0.0, -0.3 * float(np.abs(gradient).max())]
        errors = [self.answer(gradient + t * direction)[1][axis, axis] + pressure for t in tries]
        for _ in range(8):
            if abs(errors[1]) < 1e-4 * pressure or errors[1] == errors[0]:
                break
            tries = [tries[1], tries[1] - errors[1] * (tries[1] - tries[0]) / (errors[1] - errors[0])]
            errors = [errors[1], self.answer(gradient + tries[1] * direction)[1][axis, axis] + pressure]
        assert abs(errors[1]) < 1e-2 * pressure
        return self.step(gradient + tries[1] * direction)


def confined(method, angle_deg, pressure=5e3):
    """Sand under the same pressure from all sides."""
    config = MpmConfig(method=method, sand_friction_angle_deg=angle_deg, sand_grain_diameter_m=0.0)
    shear, bulk = lame_parameters(config)
    element = Element(SAND, config)
    stress = element.step(-pressure / (3 * bulk + 2 * shear) * np.eye(3))
    assert stress == pytest.approx(-pressure * np.eye(3), rel=0.01, abs=1.0)
    return element


LATERAL = {  # what is strained, what gives way so that the pressure on that side stays
    "triaxial compression": (np.diag([0, -1, 0]), np.diag([1, 0, 1])),
    "triaxial extension": (np.diag([0, 1, 0]), np.diag([1, 0, 1])),
    "plane strain": (np.diag([0, -1, 0]), np.diag([1, 0, 0])),
}


def sheared(method, angle_deg, path, steps=60, size=2e-3):
    """The mobilised friction angle of each step, degrees."""
    element = confined(method, angle_deg)
    drive, side = LATERAL[path]
    mobilised = []
    for _ in range(steps):
        stress = element.step_against(size * drive, side, 0, 5e3)
        low, _, high = np.sort(np.linalg.eigvalsh(-stress))
        mobilised.append(np.rad2deg(np.arcsin((high - low) / (high + low))))
    return mobilised


@pytest.mark.parametrize(
    ("method", "path", "angle_deg", "tolerance"),
    [
        ("corrected", "triaxial compression", 31.0, 0.06),
        ("corrected", "triaxial extension", 31.0, 0.06),
        ("corrected", "plane strain", 31.0, 0.06),
        ("taichi_elements", "triaxial compression", 31.0, 0.1),
        ("taichi_elements", "plane strain", 45.9, 0.3),
    ],
)
def test_friction_angle_of_sand(method, path, angle_deg, tolerance):
    """Sand of 31 degrees yields at 31 degrees on every path by Mohr-Coulomb's law. Taichi Elements' cone has the angle
    in triaxial compression only. Before that sand is elastic: the axial stress grows by Young's modulus times the
    strain."""
    mobilised = sheared(method, 31.0, path)
    assert mobilised[-1] == pytest.approx(angle_deg, abs=tolerance)
    if path == "triaxial compression":  # q = E strain
        q = MpmConfig().youngs_modulus_pa * 2e-3
        assert np.sin(np.deg2rad(mobilised[0])) == pytest.approx(q / (q + 2 * 5e3), rel=0.02)


def test_simple_shear_of_sand():
    """Sheared between plates under a constant load, sand carries sin phi times the load: principal axes turn to 45
    degrees, and the stress across the plane of shear is the mean of the others.
    """
    element = confined("corrected", 31.0)
    drive, side = np.zeros((3, 3)), np.diag([0, 1, 0])
    drive[0, 1] = 2e-3
    for _ in range(80):
        stress = element.step_against(drive, side, 1, 5e3)
    assert stress[0, 1] / -stress[1, 1] == pytest.approx(np.sin(np.deg2rad(31)), rel=0.01)
    assert stress[0, 0] / stress[1, 1] == pytest.approx(1, rel=0.02)
    assert 2 * stress[2, 2] / (stress[0, 0] + stress[1, 1]) == pytest.approx(1, rel=0.02)


@pytest.mark.parametrize("strain", [2e-3, 0.1])
def test_friction_grows_with_the_rate_of_shear(strain):
    """Sheared at a rate r, sand with grains of 5 mm has 1 + 0.685 / (1 + 0.279 / I) times the friction that it has
    without, I = r d sqrt(rho_grain / p) (Jop, Forterre and Pouliquen 2006).
    """
    ratios = {}
    for diameter in (0.0, 5e-3):
        element = confined("corrected", 31.0)
        element.config = dataclasses.replace(element.config, sand_grain_diameter_m=diameter)
        drive, side = np.zeros((3, 3)), np.diag([0, 1, 0])
        drive[0, 1] = strain
        for _ in range(30 + round(0.04 / strain)):
            stress = element.step_against(drive, side, 1, 5e3)
        pressure = -np.trace(stress) / 3
        ratios[diameter] = np.linalg.norm(stress + pressure * np.eye(3)) / pressure
    inertial = strain / STEP_S * 5e-3 * np.sqrt(MpmConfig().density_kg_m3 / 0.6 / pressure)
    assert ratios[5e-3] / ratios[0.0] == pytest.approx(1 + 0.685 / (1 + 0.279 / inertial), rel=3e-3)


# Stomakhin et al. 2013, table 2
PUBLISHED_SNOW = MpmConfig(
    youngs_modulus_pa=1.4e5, poisson_ratio=0.2, snow_hardening=10.0, snow_critical_compression=0.025,
    snow_critical_stretch=0.0075,
)  # fmt: skip


@pytest.mark.parametrize("length", [0.985, 0.75, 0.6, 1.005, 1.2])
def test_snow_hardens_and_breaks_as_published(length):
    """Compressed or stretched along one axis, snow bears exp(xi (1 - Jp)) times the stress at its critical compression
    or stretch (Stomakhin et al. 2013), with Jp the length over the critical one, within 2 %, and 20 times at most.
    Unloaded it yields by the hardened modulus.
    """
    config = PUBLISHED_SNOW
    shear, bulk = lame_parameters(config)
    bounded = np.clip(length, 0.975, 1.0075)
    factor = min(np.exp(10 * (1 - length / bounded)), CAP)
    element, steps = Element(SNOW, config), 200
    for _ in range(steps):
        element.step(np.diag([length ** (1 / steps) - 1, 0, 0]))
    _, stress, _ = element.answer(np.zeros((3, 3)))
    along = factor * (2 * shear * (bounded - 1) * bounded + bulk * bounded * (bounded - 1))
    assert stress[0, 0] == pytest.approx(along, rel=0.02)
    assert stress[1, 1] == pytest.approx(factor * bulk * bounded * (bounded - 1), rel=0.02)
    if length < 1:
        relieved = element.step(np.diag([1e-3, 0, 0]))[0, 0] - stress[0, 0]
        slope = 2 * shear * bounded * (2 * bounded - 1) + bulk * bounded * (2 * bounded - 1)
        assert relieved == pytest.approx(1e-3 * factor * slope, rel=0.03)


@pytest.mark.parametrize("shear_strain", [0.01, 0.5, 2.0])
def test_simple_shear_of_an_elastic_solid(shear_strain):
    """Sheared by g without a change of volume, a fixed corotated solid turns by R = [[c, s], [-s, c]] with tan = g / 2:
    it bears 2 mu (g - s) along, 2 mu (1 + g² - c - s g) and 2 mu (1 - c) across (Poynting's effect).
    """
    element = Element(ELASTIC, MpmConfig())
    drive = np.zeros((3, 3))
    drive[0, 1] = shear_strain / 50
    for _ in range(50):
        stress = element.step(drive)
    shear, _ = lame_parameters(MpmConfig())
    c, s = np.array([2, shear_strain]) / np.hypot(2, shear_strain)
    expected = np.zeros((3, 3))
    expected[0, 1] = expected[1, 0] = shear_strain - s
    expected[0, 0], expected[1, 1] = 1 + shear_strain**2 - c - s * shear_strain, 1 - c
    assert stress == pytest.approx(2 * shear * expected, abs=3e-5 * shear * (1 + shear_strain**2))


def test_stretch_of_an_elastic_solid_with_free_sides():
    """Pulled by 1 % with free sides it bears Young's modulus times the strain, and narrows by Poisson's ratio."""
    config, element = MpmConfig(), Element(ELASTIC, MpmConfig())
    for _ in range(10):
        gradient = np.diag([1e-3, -config.poisson_ratio * 1e-3, -config.poisson_ratio * 1e-3])
        stress = element.step(gradient)
    assert stress[0, 0] == pytest.approx(config.youngs_modulus_pa * 0.01, rel=0.02)
    assert abs(stress[1, 1]) < 0.01 * stress[0, 0]
