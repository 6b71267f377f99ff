"""The constitutive laws of one particle, for Taichi kernels: water, sand, snow (Taichi Elements' materials), elastic.

Every law maps the trial deformation of a step to the new state and the Kirchhoff stress (stress times J, per initial
volume, in pascals). `law` contains rows of constants (layout.Constant), and the particle's row begins at `row`.
The state of a particle is F (not of water) and one scalar, `volume`: J for water, the volume correction v_c for sand
(Tampubolon et al. 2017), the plastic volume ratio Jp for snow (Stomakhin et al. 2013).
"""

import taichi as ti

from datagen.mpm.layout import CONSTANT, COUNT, VARIANT, is_only_solid
from datagen.mpm.svd import svd3
from hgn.scene.material import ELASTIC, SAND, SNOW, WATER
from hgn.solver_method import MINIMUM_SINGULAR_VALUE, WATER_MINIMUM_VOLUME_RATIO

# bounds of Jp: below the first one hardening is capped, above the second one the stiffness vanishes
SMALLEST_PLASTIC_VOLUME, LARGEST_PLASTIC_VOLUME = 1e-3, 1e3
LARGEST_VOLUME = 1e12  # bound of an elastic solid's J; the stress contains its square
# Factor of an elastic solid's stiffness for the time step. A single particle that hits the floor at 10 m/s gains energy
# with steps of 0.8 of the limit, but not with 0.65. With a factor of 1.6 they are 0.875 / sqrt(1.6) = 0.69 of it.
ELASTIC_MARGIN = 1.6
# mu(I) = mu_s (1 + RATE_FRICTION / (1 + RATE_NUMBER / I)). The values are those of Jop, Forterre and Pouliquen 2006 for
# glass beads: mu_s = tan 20.9, mu_2 = tan 32.76 degrees
RATE_FRICTION, RATE_NUMBER = 0.685, 0.279


@ti.func
def count_event(counter: ti.template(), scene: ti.i32, event: ti.template(), times: ti.i32):
    if times > 0:
        ti.atomic_add(counter[scene, event], ti.cast(times, ti.i64))


@ti.func
def hardening(plastic_volume: ti.f32, law: ti.template(), row: ti.i32) -> ti.f32:
    """Returns exp(xi (1 - Jp)), capped."""
    cap = law[row + CONSTANT.maximum_hardening]
    exponent = law[row + CONSTANT.hardening] * (1.0 - plastic_volume)
    return ti.min(ti.exp(ti.min(exponent, 80.0)), cap)


@ti.func
def water(volume: ti.f32, expansion: ti.f32, law: ti.template(), row: ti.i32, counter: ti.template(), scene: ti.i32):
    """Returns J (1 + expansion), bounded below, the Kirchhoff stress lambda J (J - 1), and the present stiffness, Pa.

    The expansion of a step is dt tr C. Taichi Elements' det(1 + dt C) - 1 expands rotating water and compresses sheared
    water, to second order in the step. Stretched water bears a fraction of its tension, a constant of the law. With 0
    it has no pressure until it is compressed again.
    """
    bulk = law[row + CONSTANT.bulk]
    J = volume * (1.0 + expansion)
    if J < WATER_MINIMUM_VOLUME_RATIO:
        J = WATER_MINIMUM_VOLUME_RATIO
        count_event(counter, scene, COUNT.water_volume_floors, 1)
    # d(tau) / d(log J) is lambda J (2 J - 1), so stretched water is stiffer than water at rest
    stress = bulk * J * (J - 1.0)
    stiffness = J * (2.0 * J - 1.0)
    if J > 1.0:
        stress *= law[row + CONSTANT.water_tension]
    return J, stress, 3.0 * bulk * ti.max(1.0, stiffness)


@ti.func
def settled(volume: ti.f32, density: ti.f32, share: ti.f32) -> ti.f32:
    """Returns water's J, moved by the fraction `share` towards 1 / `density` (bounded).

    `density` is relative to that at rest. J is integrated along each particle's path, and drifts from the density,
    because few particles sample the flow. Near a free surface J is kept, because the spline extends out of the water.
    """
    inside = ti.min(ti.max(10.0 * (density - 0.85), 0.0), 1.0)
    told = 1.0 / ti.min(ti.max(density, 0.8), 1.25)
    return volume + inside * share * (told - volume)


@ti.func
def _project_sand(log_strain, volume: ti.f32, law: ti.template(), row: ti.i32, step: ti.f32, variant: ti.template()):
    """Returns the principal log strains after the return mapping, and the new volume correction.

    Stress tau with the deviator s yields if |s| > alpha (-tr tau). At |s| = alpha (-tr tau) the largest and smallest
    principal stress satisfy |tau_1 - tau_3| = |tau_1 + tau_3| sin phi (Mohr-Coulomb). In Taichi Elements alpha is
    constant (Drucker-Prager). The mapping shortens s and keeps its direction, so the volume stays. With grains alpha
    grows with the inertial number I = rate d sqrt(rho_grain / p) of the step's plastic shear (Jop et al. 2006).

    Volume correction (Tampubolon et al. 2017): v_c / 3 is added to each log strain first, and
    v_c += log det F_trial - log det F_new. In Taichi Elements v_c enters the trace but not the strains.
    """
    strain = log_strain
    trace = log_strain.sum() + volume
    if ti.static(not variant & VARIANT.taichi_elements):
        strain = log_strain + volume / 3.0
    deviator = strain - trace / 3.0
    new_volume = 0.0
    new_strain = ti.Vector([0.0, 0.0, 0.0])
    if trace >= 0.0:
        new_volume = trace
    else:
        shear = law[row + CONSTANT.shear]
        bulk = law[row + CONSTANT.bulk]
        size = deviator.norm() + 1e-20
        alpha = law[row + CONSTANT.sand_alpha]
        if ti.static(not variant & VARIANT.taichi_elements):
            sine = law[row + CONSTANT.sand_sine]
            # n1 > n2 > n3, the unit deviator, sum to 0; stress |s| n - p: |s| (n1 - n3) = (2 p + |s| n2) sin phi
            direction = deviator / size
            largest, least = direction.max(), direction.min()
            # except for rounding errors the denominator is at least 0.8
            alpha = 2.0 / 3.0 * sine / ti.max(largest - least + sine * (largest + least), 0.5)
        bearing = -(3.0 * bulk + 2.0 * shear) / (2.0 * shear) * trace * alpha
        excess = ti.max(size - bearing, 0.0)
        if ti.static(bool(variant & VARIANT.rate_of_sand)):
            # `excess` becomes its plastic part x: (excess - x) (k x + RATE_NUMBER) = bearing RATE_FRICTION k x, k x = I
            pressure = ti.max(-(3.0 * bulk + 2.0 * shear) / 3.0 * trace, 1e-3)
            k = law[row + CONSTANT.grain] / (step * ti.sqrt(pressure))
            half = 0.5 * (RATE_NUMBER + k * (bearing * RATE_FRICTION - excess))
            root = ti.sqrt(half * half + k * excess * RATE_NUMBER)
            if half > 0.0:
                excess = excess * RATE_NUMBER / (half + root)
            else:
                excess = (root - half) / k
        # v_c was added to the strains, and the mapping keeps their trace. F then contains v_c, so v_c is set to 0.
        new_strain = strain - deviator * (excess / size)
    return new_strain, new_volume


@ti.func
def foreseen_stiffness(
    C, volume: ti.f32, material: ti.i32, time: ti.f32, inverse_dx: ti.f32, law: ti.template(), row: ti.i32,
    variant: ti.template(),
) -> ti.f32:  # fmt: skip
    """Returns (3 lambda + 2 mu) / density of a particle after `time` with the velocity gradient C.

    For elastic solids it returns 1e30 / density, so that they take no longer steps of their own: only a decomposition
    would give their stretch.
    """
    density = law[row + CONSTANT.density]
    bulk = 3.0 * law[row + CONSTANT.bulk]
    stiffness = bulk + 2.0 * law[row + CONSTANT.shear]
    change = ti.abs(C.trace()) * time
    if ti.static(bool(variant & VARIANT.water)):
        if material == WATER:
            J = volume * (1.0 + change)
            rough = ti.sqrt(bulk * ti.max(1.0, J * (2.0 * J - 1.0)))
            rough += 4.0 * law[row + CONSTANT.viscosity] * inverse_dx / ti.sqrt(density)
            stiffness = rough * rough
    if ti.static(bool(variant & VARIANT.snow)):
        if material == SNOW:
            stiffness *= hardening(volume * (1.0 - change), law, row)
    if ti.static(bool(variant & VARIANT.elastic)):
        if material == ELASTIC:
            stiffness = 1e30
    return stiffness / density


@ti.func
def solid(
    F, volume: ti.f32, material: ti.i32, law: ti.template(), row: ti.i32, counter: ti.template(), scene: ti.i32,
    variant: ti.template(), step: ti.f32,
):  # fmt: skip
    """Returns new F, new volume, Kirchhoff stress and present stiffness of sand, snow and elastic solids from trial F.

    Undeformed, the stiffness is 3 lambda + 2 mu. Elastic solids, and snow until it yields, are fixed corotated
    (Stomakhin et al. 2012), tau = 2 mu (F - R) Fᵀ + lambda J (J - 1). Stretch raises their d(tau) / d(log sigma).
    """
    sand = ti.static(bool(variant & VARIANT.sand))
    snow = ti.static(bool(variant & VARIANT.snow))
    elastic = ti.static(bool(variant & VARIANT.elastic))
    shear = law[row + CONSTANT.shear]
    bulk = law[row + CONSTANT.bulk]
    U, sigma, V = svd3(F)
    floors = 0
    for i in ti.static(range(3)):
        if sigma[i] < MINIMUM_SINGULAR_VALUE:
            sigma[i] = MINIMUM_SINGULAR_VALUE
            floors += 1
    count_event(counter, scene, COUNT.singular_value_floors, floors)
    new_sigma = sigma
    new_volume = volume
    plastic = floors
    stiffness = 3.0 * bulk + 2.0 * shear
    stress = ti.Vector([0.0, 0.0, 0.0])
    if ti.static(sand):
        if ti.static(is_only_solid(variant, VARIANT.sand)) or material == SAND:
            log_strain = ti.log(sigma)
            strain, new_volume_ = _project_sand(log_strain, volume, law, row, step, variant)
            new_volume = new_volume_
            for i in ti.static(range(3)):
                if strain[i] != log_strain[i]:
                    new_sigma[i] = ti.exp(strain[i])
                    plastic += 1
            stress = 2.0 * shear * strain + bulk * strain.sum()
    if ti.static(snow):
        if ti.static(is_only_solid(variant, VARIANT.snow)) or material == SNOW:
            h = hardening(volume, law, row)
            ratio = 1.0
            for i in ti.static(range(3)):
                low = law[row + CONSTANT.snow_smallest]
                high = law[row + CONSTANT.snow_largest]
                bounded = ti.min(ti.max(sigma[i], low), high)
                if bounded != sigma[i]:
                    ratio *= sigma[i] / bounded
                    new_sigma[i] = bounded
                    plastic += 1
            new_volume = volume * ratio
            if new_volume < SMALLEST_PLASTIC_VOLUME or new_volume > LARGEST_PLASTIC_VOLUME:
                new_volume = ti.min(ti.max(new_volume, SMALLEST_PLASTIC_VOLUME), LARGEST_PLASTIC_VOLUME)
                count_event(counter, scene, COUNT.plastic_volume_bounds, 1)
            new_h = hardening(new_volume, law, row)
            if new_h >= law[row + CONSTANT.maximum_hardening]:
                count_event(counter, scene, COUNT.hardening_caps, 1)
            stiffness *= new_h
            J = new_sigma[0] * new_sigma[1] * new_sigma[2]
            stress = 2.0 * shear * h * (new_sigma - 1.0) * new_sigma + bulk * h * J * (J - 1.0)
    if ti.static(elastic):
        if ti.static(is_only_solid(variant, VARIANT.elastic)) or material == ELASTIC:
            J = ti.min(sigma[0] * sigma[1] * sigma[2], LARGEST_VOLUME)
            stress = 2.0 * shear * (sigma - 1.0) * sigma + bulk * J * (J - 1.0)
            widest = sigma.max()
            stiffness = 3.0 * bulk * ti.max(1.0, J * (2.0 * J - 1.0))
            stiffness += 2.0 * shear * ti.max(1.0, widest * (2.0 * widest - 1.0))
            stiffness *= ELASTIC_MARGIN
    new_F = F
    if plastic > 0:  # otherwise F stays, because a decomposition and composition would round det F
        new_F = _compose(U, new_sigma, V)
    return new_F, new_volume, _compose(U, stress, U), stiffness


@ti.func
def _compose(U, diagonal, V):
    """Returns U diag(diagonal) Vᵀ."""
    out = ti.Matrix.zero(ti.f32, 3, 3)
    for i, j in ti.static(ti.ndrange(3, 3)):
        out[i, j] = U[i, 0] * diagonal[0] * V[j, 0] + U[i, 1] * diagonal[1] * V[j, 1] + U[i, 2] * diagonal[2] * V[j, 2]
    return out
