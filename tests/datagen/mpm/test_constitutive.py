"""The laws of one particle against a float64 reference that follows the published formulas."""

import dataclasses
from collections import namedtuple

import numpy as np
import pytest
import taichi as ti

from datagen.mpm import layout
from datagen.mpm.constitutive import solid
from datagen.mpm.layout import (
    COUNT,
    MATERIAL_VARIANTS,
    SETTING,
    SOLID_VARIANTS,
    VARIANT,
    constants,
    is_only_solid,
    lame_parameters,
)
from datagen.mpm.mls_mpm import respond
from hgn.config import MpmConfig
from hgn.scene.material import ELASTIC, SAND, SNOW, WATER
from hgn.solver_method import METHODS

Matrices = ti.types.ndarray(dtype=ti.types.matrix(3, 3, ti.f32), ndim=1)
Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)
STEP_S = 1e-3
CAP = METHODS["corrected"].snow_maximum_hardening
LOAD = 5e3  # Pa

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


def run(material, F_N33, volume_N, config):
    """F, volumes, stresses, stiffness and counters of particles of a solid behind a step: bitwise the same in a kernel
    of this solid only."""
    outcomes = []
    for variant in (SOLID_VARIANTS, MATERIAL_VARIANTS[material]):
        F, stress = np.float32(F_N33), np.zeros_like(F_N33, np.float32)
        volume, stiffness = np.float32(volume_N), np.zeros_like(volume_N, np.float32)
        counter = np.zeros((1, COUNT.length), np.int64)
        variant += VARIANT.taichi_elements * (config.method == "taichi_elements")
        variant += VARIANT.rate_of_sand * (config.sand_grain_diameter_m > 0)
        update_solids(F, volume, stress, stiffness, material, constants(config), counter, variant)
        outcomes.append((F, volume, stress, stiffness, counter[0]))
    assert all(np.array_equal(shared, own) for shared, own in zip(*outcomes, strict=True))
    return outcomes[0]


def moved_water(C_N33, volume_N, step, variant=0, config=None, dx=1.0):
    """Stresses, volumes, stiffness and the counter of floors of particles of water behind a step."""
    setting, config = np.ones(SETTING.length, np.float32), config or MpmConfig()
    setting[SETTING.inverse_cell_size] = 1 / dx
    C, volume, counter = np.float32(C_N33), np.float32(volume_N), np.zeros((1, COUNT.length), np.int64)
    response, stiffness = np.zeros_like(C), np.zeros_like(volume)
    move_water(C, response, stiffness, volume, step, setting, constants(config), counter, VARIANT.water + variant)
    stress = response / (-4 / dx**2 / config.density_kg_m3)
    return stress, volume, stiffness, counter[0, COUNT.water_volume_floors]


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
    sine = np.sin(np.deg2rad(config.sand_friction_angle_deg))
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
                d = np.sort(deviator) / size
                largest = 2 * pressure * sine / (d[2] - d[0] + (d[0] + d[2]) * sine)
            else:
                largest = 3 * np.sqrt(2 / 3) * 2 * sine / (3 - sine) * pressure
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


def test_water():
    """J <- J (1 + dt tr C), tau = lambda J (J - 1); J is floored and the floors are counted. Stretched water bears the
    share of the tension that it is given, none with 0; water under pressure does not know of it.
    """
    J, expansion = np.array([1.0, 0.9, 1.2, 0.15, 1.0]), np.array([1e-3, -0.2, 0.1, -0.5, -3.0])
    new_J = np.maximum(J * (1 + expansion), 0.1)
    for share in (1.0, 0.5, 0.0):
        config = MpmConfig(water_tension=share)
        pressure = lame_parameters(config)[1] * new_J * (new_J - 1) * np.where(new_J > 1, share, 1.0)
        stress, volume, _, floors = moved_water(expansion[:, None, None] / 3 * np.eye(3), J, 1.0, config=config)
        close(volume, new_J, 1e-6)
        close(stress, pressure[:, None, None] * np.eye(3), 1e-6)
        assert floors == 2


def test_volume_updates_of_water():
    """J *= 1 + dt tr C keeps the volume of turning and purely sheared water; Taichi Elements' determinant does not."""
    rate, step = 50.0, 1e-3
    turning = np.array([[0.0, -rate, 0], [rate, 0, 0], [0, 0, 0]])
    C_N33 = np.stack([turning, np.diag([rate, -rate, 0]), np.diag([rate, rate, -rate])])
    for bit, factor in ((0, 1 + step * np.trace(C_N33, axis1=1, axis2=2)),
                        (VARIANT.taichi_elements, np.linalg.det(np.eye(3) + step * C_N33))):  # fmt: skip
        _, volume_N, *_ = moved_water(C_N33, np.full(3, 0.9), step, bit)
        close(volume_N, 0.9 * factor, 1e-6)


def test_viscous_stress():
    """Sheared at a rate, viscous water bears the rate times its viscosity across the shear, and no other stress."""
    rate, viscosity, dx, config = 50.0, 3.0, 0.1, MpmConfig(water_viscosity_pa_s=3.0)
    C_N33 = np.array([[[0.0, rate, 0], [0, 0, 0], [0, 0, 0]]])
    stress, _, stiffness_N, _ = moved_water(C_N33, np.ones(1), 1e-4, config=config, dx=dx)
    expected = viscosity * rate * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    assert stress[0] == pytest.approx(expected, rel=1e-5, abs=0.05)
    rough = np.sqrt(3 * lame_parameters(config)[1] / 1000) + 4 * viscosity / (1000 * dx)
    assert stiffness_N[0] == pytest.approx(rough**2, rel=1e-4)


def test_a_new_solid_is_told_from_the_others(monkeypatch):
    """A kernel leaves out the look at a particle's material only where there is one solid, a solid to come included."""
    assert is_only_solid(VARIANT.sand | VARIANT.water | VARIANT.contact, VARIANT.sand)
    assert not is_only_solid(VARIANT.sand | VARIANT.snow, VARIANT.sand)
    clay = 2 * VARIANT.parts
    monkeypatch.setattr(layout, "SOLID_VARIANTS", SOLID_VARIANTS | clay)
    assert not is_only_solid(VARIANT.sand | clay, VARIANT.sand)


@pytest.mark.parametrize("material", [SAND, SNOW, ELASTIC])
def test_without_flow_and_after_collapse(material):
    """Without plastic flow F is not recomposed: a thousand updates leave every bit as it was. Singular, inverted, huge
    F: finite results with every singular value at least 0.05, each floor counted."""
    F = np.eye(3) + 1e-3 * np.random.default_rng(3).normal(size=(50, 3, 3)) - 5e-3 * np.eye(3)
    F = F.astype(np.float32)
    rest = 0.0 if material == SAND else 1.0
    got, got_volume, *_ = run(material, F, np.full(50, rest), MpmConfig())
    assert np.array_equal(got, F) and (got_volume == rest).all()
    F = np.array([np.zeros((3, 3)), -np.eye(3), np.diag([1.0, 1, -1]), np.diag([1.0, 0, 0]), 1e6 * np.eye(3)])
    *results, counter = run(material, F, np.full(5, rest), MpmConfig())
    assert all(np.isfinite(values).all() for values in results)
    assert np.linalg.svd(results[0], compute_uv=False).min() > 0.0499 and (np.linalg.det(results[0]) > 0).all()
    assert counter[COUNT.singular_value_floors] == 3 + 1 + 1 + 2
    if material == SNOW:
        assert counter[COUNT.plastic_volume_bounds] == 2  # the zero matrix and the huge one


class Element:
    """One particle that is strained step by step, as an element of soil is in a laboratory."""

    def __init__(self, material, config):
        self.material, self.config, self.F = material, config, np.eye(3)
        self.volume = 0.0 if material == SAND else 1.0

    def answers(self, *gradients):
        """F, Kirchhoff stress and volume scalar after a step of each gradient (times its time), not yet taken."""
        F = (np.eye(3) + np.array(gradients)) @ self.F
        F, volume, stress, *_ = run(self.material, F, np.full(len(F), self.volume), self.config)
        return list(zip(F.astype(float), stress.astype(float), volume.astype(float), strict=True))

    def take(self, answer):
        self.F, stress, self.volume = answer
        return stress

    def step(self, gradient):
        return self.take(*self.answers(gradient))

    def step_against(self, gradient, direction, axis, pressure=LOAD):
        """A step with as much of `direction` as keeps the stress along `axis` at -pressure (secant method)."""
        tries = [0.0, -0.3 * float(np.abs(gradient).max())]
        answers = self.answers(*(gradient + t * direction for t in tries))
        for _ in range(9):
            errors = [stress[axis, axis] + pressure for _, stress, _ in answers]
            if abs(errors[1]) < 1e-4 * pressure or errors[1] == errors[0]:
                break
            tries = [tries[1], tries[1] - errors[1] * (tries[1] - tries[0]) / (errors[1] - errors[0])]
            answers = [answers[1], *self.answers(gradient + tries[1] * direction)]
        assert abs(errors[1]) < 1e-2 * pressure
        return self.take(answers[1])


def confined(method="corrected", **changes):
    """Sand of 31 degrees under the same pressure from all sides."""
    config = MpmConfig(method=method, sand_friction_angle_deg=31.0, sand_grain_diameter_m=0.0)
    shear, bulk = lame_parameters(config)
    element = Element(SAND, config)
    stress = element.step(-LOAD / (3 * bulk + 2 * shear) * np.eye(3))
    assert stress == pytest.approx(-LOAD * np.eye(3), rel=0.01, abs=1.0)
    element.config = dataclasses.replace(config, **changes)
    return element


def entry(row, column, value):
    out = np.zeros((3, 3))
    out[row, column] = value
    return out


def friction_angle(method, drive, side, angle_deg, tolerance):
    """Sand of 31 degrees yields at 31 degrees on every path by Mohr-Coulomb's law; Taichi Elements' cone has the angle
    in triaxial compression only. Before that the axial stress grows by Young's modulus times the strain.
    """
    element, mobilised = confined(method), []
    for _ in range(60):
        low, _, high = np.sort(np.linalg.eigvalsh(-element.step_against(2e-3 * np.diag(drive), np.diag(side), 0)))
        mobilised.append(np.rad2deg(np.arcsin((high - low) / (high + low))))
    yield "angle", mobilised[-1], angle_deg, tolerance
    if (drive, side) == COMPRESSION:  # q = E strain
        q = MpmConfig().youngs_modulus_pa * 2e-3
        expected = q / (q + 2 * LOAD)
        yield "first stress", np.sin(np.deg2rad(mobilised[0])), expected, 0.02 * expected


def simple_shear_of_sand():
    """Sheared between plates under a constant load, sand carries sin phi times the load: principal axes turn to 45
    degrees, and the stress across the plane of shear is the mean of the others.
    """
    element = confined()
    for _ in range(80):
        stress = element.step_against(entry(0, 1, 2e-3), np.diag([0, 1, 0]), 1)
    yield "friction", stress[0, 1] / -stress[1, 1], np.sin(np.deg2rad(31)), 0.01 * np.sin(np.deg2rad(31))
    yield "along", stress[0, 0] / stress[1, 1], 1, 0.02
    yield "across", 2 * stress[2, 2] / (stress[0, 0] + stress[1, 1]), 1, 0.02


def friction_by_rate(strain):
    """Sheared at a rate r, sand with grains of 5 mm has 1 + 0.685 / (1 + 0.279 / I) times the friction that it has
    without, I = r d sqrt(rho_grain / p) (Jop, Forterre and Pouliquen 2006).
    """
    ratios = []
    for diameter in (0.0, 5e-3):
        element = confined(sand_grain_diameter_m=diameter)
        for _ in range(30 + round(0.04 / strain)):
            stress = element.step_against(entry(0, 1, strain), np.diag([0, 1, 0]), 1)
        pressure = -np.trace(stress) / 3
        ratios.append(np.linalg.norm(stress + pressure * np.eye(3)) / pressure)
    inertial = strain / STEP_S * 5e-3 * np.sqrt(MpmConfig().density_kg_m3 / 0.6 / pressure)
    expected = 1 + 0.685 / (1 + 0.279 / inertial)
    yield "friction", ratios[1] / ratios[0], expected, 3e-3 * expected


def snow_along_one_axis(length):
    """Compressed or stretched along one axis, snow bears exp(xi (1 - Jp)) times the stress at its critical compression
    or stretch (Stomakhin et al. 2013, constants of table 2), with Jp the length over the critical one, and 20 times at
    most. Unloaded it yields by the hardened modulus.
    """
    config = MpmConfig(
        youngs_modulus_pa=1.4e5, poisson_ratio=0.2, snow_hardening=10.0, snow_critical_compression=0.025,
        snow_critical_stretch=0.0075,
    )  # fmt: skip
    shear, bulk = lame_parameters(config)
    bounded = np.clip(length, 0.975, 1.0075)
    factor = min(np.exp(10 * (1 - length / bounded)), CAP)
    element, steps = Element(SNOW, config), 200
    for _ in range(steps):
        element.step(np.diag([length ** (1 / steps) - 1, 0, 0]))
    ((_, stress, _),) = element.answers(np.zeros((3, 3)))
    across = factor * bulk * bounded * (bounded - 1)
    along = across + factor * 2 * shear * (bounded - 1) * bounded
    yield "along", stress[0, 0], along, 0.02 * abs(along)
    yield "across", stress[1, 1], across, 0.02 * abs(across)
    if length < 1:
        slope = 1e-3 * factor * (2 * shear + bulk) * bounded * (2 * bounded - 1)
        yield "relief", element.step(np.diag([1e-3, 0, 0]))[0, 0] - stress[0, 0], slope, 0.03 * slope


def simple_shear_of_an_elastic_solid(strain):
    """Sheared by g without a change of volume, a fixed corotated solid turns by R = [[c, s], [-s, c]] with tan = g / 2:
    it bears 2 mu (g - s) along, 2 mu (1 + g² - c - s g) and 2 mu (1 - c) across (Poynting's effect).
    """
    element = Element(ELASTIC, MpmConfig())
    for _ in range(50):
        stress = element.step(entry(0, 1, strain / 50))
    shear, _ = lame_parameters(MpmConfig())
    c, s = np.array([2, strain]) / np.hypot(2, strain)
    expected = np.diag([1 + strain**2 - c - s * strain, 1 - c, 0]) + entry(0, 1, strain - s) + entry(1, 0, strain - s)
    yield "stress", np.abs(stress - 2 * shear * expected).max(), 0, 3e-5 * shear * (1 + strain**2)


def stretch_of_an_elastic_solid_with_free_sides():
    """Pulled by 1 % with free sides it bears Young's modulus times the strain, and narrows by Poisson's ratio."""
    config, element = MpmConfig(), Element(ELASTIC, MpmConfig())
    for _ in range(10):
        stress = element.step(1e-3 * np.diag([1, -config.poisson_ratio, -config.poisson_ratio]))
    yield "along", stress[0, 0], config.youngs_modulus_pa * 0.01, 0.02 * config.youngs_modulus_pa * 0.01
    yield "across", stress[1, 1], 0, 0.01 * stress[0, 0]


# what is strained, what gives way so that the pressure on that side stays
COMPRESSION, EXTENSION, PLANE = ([0, -1, 0], [1, 0, 1]), ([0, 1, 0], [1, 0, 1]), ([0, -1, 0], [1, 0, 0])
ELEMENTS = [
    *((friction_angle, "corrected", *path, 31.0, 0.06) for path in (COMPRESSION, EXTENSION, PLANE)),
    (friction_angle, "taichi_elements", *COMPRESSION, 31.0, 0.1),
    (friction_angle, "taichi_elements", *PLANE, 45.9, 0.3),
    (simple_shear_of_sand,),
    *((friction_by_rate, strain) for strain in (2e-3, 0.1)),
    *((snow_along_one_axis, length) for length in (0.985, 0.75, 0.6, 1.005, 1.2)),
    *((simple_shear_of_an_elastic_solid, strain) for strain in (0.01, 0.5, 2.0)),
    (stretch_of_an_elastic_solid_with_free_sides,),
]


@pytest.mark.parametrize("case", ELEMENTS, ids=lambda case: f"{case[0].__name__} {case[-1] if case[1:] else ''}")
def test_closed_forms_of_an_element(case):
    """The measured value is the expected one within its tolerance."""
    make, *arguments = case
    rows = list(make(*arguments))
    wrong = [(what, found, expected) for what, found, expected, tolerance in rows if abs(found - expected) > tolerance]
    assert rows and not wrong
