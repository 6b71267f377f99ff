"""Settings shared by the commands, as dataclasses. Hydra composes YAML; the dataclasses validate it once per command.
Settings that only one command has are at the top of that command's file.

Other code sees only dataclasses, never a DictConfig. Numbers that follow from settings are properties.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from hgn.scene.kinds import require_few_cells, require_funnel, require_kinds
from hgn.scene.material import MATERIAL_NAME, MATERIALS, OWN_PHYSICS, PAPER_MATERIALS
from hgn.schema import (
    AtMostOne,
    BelowOne,
    Bound,
    Bounded,
    BoxSize,
    ConfigError,
    FewLayers,
    FolderName,
    Fraction,
    FrameCount,
    FrameRate,
    LayerSize,
    NonNegative,
    OneOrMore,
    OrdinarySize,
    Positive,
    Vector,
    one_of,
    require,
    require_bounds,
)
from hgn.solver_method import METHODS, SolverMethod
from hgn.step_config import StepConfig

MOST_OBSTACLES = 1000  # largest number of obstacles in a random scene
FewObstacles = Annotated[NonNegative[int], Bound("at most 1,000", lambda count: count <= MOST_OBSTACLES)]
OBSTACLE_SHAPES = ("half_box", "square", "half_sphere", "cone", "pyramid")
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb")
USD_ENDINGS = (".usdc", ".usda", ".usd")
GROUP_SHAPES = ("cube", "sphere")
NETWORK_KINDS = ("hgn", "gns")
BACKENDS = ("auto", "torch", "triton", "cpu")
PRECISIONS = ("fp32", "tf32", "fp16")
LOGGERS = ("tensorboard", "wandb", "mlflow")
SIMULATED_FRAMES = 3  # frames that pushforward needs of an episode: start, one simulated frame, its target
DEFAULT_WEIGHTS = "mechanics"  # shipped weights that commands and `Simulator.load` use
Material = Annotated[str, one_of(*MATERIALS)]
OwnPhysics = tuple[Annotated[str, one_of(*OWN_PHYSICS)], ...]
MaterialName = Annotated[
    str, Bound("a name of lower-case letters, digits and _", lambda name: MATERIAL_NAME.fullmatch(name) is not None)
]
DeviceName = Annotated[str, one_of("auto", "cpu", "cuda")]
BackendName = Annotated[str, one_of(*BACKENDS)]
Precision = Annotated[str, one_of(*PRECISIONS)]
PrecisionOrAuto = Annotated[str, one_of("auto", *PRECISIONS)]
StoredPrecision = Annotated[str, one_of("fp32", "fp16")]
Split = Annotated[str, one_of("train", "validation", "test")]
MATERIAL_EMBEDDING = 16  # number of values that a network learns for each material (paper: E)


def config_directory() -> Path:
    """Returns the folder with the Hydra configs: inside the installed package, or next to it in a checkout."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "conf", package.parent / "conf"):
        if (candidate / "datagen.yaml").is_file():
            return candidate
    raise ConfigError(f"conf/ must be in {package} or next to it, got neither; reinstall the package")


def is_mesh_file(name: str | Path) -> bool:
    """Returns whether a name has the suffix of a mesh file."""
    return Path(name).suffix.lower() in (*MESH_SUFFIXES, *USD_ENDINGS)


@dataclass(frozen=True)
class SceneConfig:
    """The distribution of random scenes (paper sec. 3.3). Lengths are in domain units."""

    domain_size: BoxSize = (1.0, 1.0, 1.0)  # edges of the box, which starts at the origin
    cell_size: Positive[float] = 1 / 64  # edge of the solver's cells
    gravity: Vector = (0.0, -9.8, 0.0)  # domain units per second squared
    obstacle_count: FewObstacles = 5  # number of obstacles in a scene
    obstacle_shapes: tuple[str, ...] = OBSTACLE_SHAPES  # or mesh files, scaled so that the longest side is the size
    obstacle_size: tuple[float, float] = (0.1, 0.5)  # smallest and largest size of an obstacle
    group_count: NonNegative[int] = 4  # number of particle groups in a scene
    group_shapes: tuple[Annotated[str, one_of(*GROUP_SHAPES)], ...] = GROUP_SHAPES  # shapes to draw from for each group
    group_size: Positive[float] = 0.08  # side or diameter of a group
    materials: tuple[Material, ...] = PAPER_MATERIALS  # materials to draw from for each group
    particles_per_cell: Positive[float] = 8.0  # particles in a solver cell at the start
    maximum_initial_speed: NonNegative[float] = 0.0  # domain units per second; moving groups draw a velocity
    # fraction of groups with an initial velocity, if maximum_initial_speed is above 0
    moving_group_fraction: Fraction[float] = 1.0
    lone_particles: NonNegative[int] = 0  # single particles far from all others, so that networks learn their fall
    # fraction of moving groups whose velocity is exactly along gravity, against it or perpendicular to it
    pure_direction_fraction: Fraction[float] = 0.0
    colliding_scene_fraction: Fraction[float] = 0.0  # fraction of scenes with colliding groups and without obstacles
    zero_gravity_fraction: Fraction[float] = 0.0  # fraction of scenes without gravity
    # fraction of scenes with gravity of any direction and any size up to 19.6 domain units per second squared
    tilted_gravity_fraction: Fraction[float] = 0.0
    # fraction of scenes with a funnel below the groups, if they have gravity and no collisions; it consists of four
    # square obstacles of 0.5 to 0.8 times the largest obstacle_size
    funnel_scene_fraction: Fraction[float] = 0.0
    funnel_hole: tuple[float, float] = (0.035, 0.14)  # smallest and largest side of a funnel's square hole
    # fraction of each kind of hgn.scene.world, as in conf/scene/world.yaml; kinds draw all settings but domain_size
    # (the largest), cell_size, materials and particles_per_cell; empty: scenes follow the settings above
    kinds: dict[str, float] = field(default_factory=dict)
    # friction: a third of the scenes draws it for each obstacle, the floor and the walls; parameters: a third draws
    # those of hgn.scene.material for each group; moving: a sixth of the scenes with kinds has a moving obstacle;
    # elastic: a sixth has elastic bodies
    own_physics: OwnPhysics = ()

    def __post_init__(self) -> None:
        require_bounds(self)
        other = self.zero_gravity_fraction + self.tilted_gravity_fraction
        rule = f"at most 1 - zero_gravity_fraction ({self.zero_gravity_fraction:g})"
        require(other <= 1, "tilted_gravity_fraction", rule, self.tilted_gravity_fraction)
        for name in ("pure_direction_fraction", "colliding_scene_fraction"):
            moving = self.maximum_initial_speed > 0 or getattr(self, name) == 0
            require(moving, "maximum_initial_speed", f"above 0 if {name} is", self.maximum_initial_speed)
        for name in ("obstacle_size", "funnel_hole"):
            low, high = getattr(self, name)
            require(0 < low <= high < math.inf, name, "0 < smallest <= largest", [low, high])
        require_funnel(self)
        for i, name in enumerate(self.obstacle_shapes):
            rule = f"one of {', '.join(OBSTACLE_SHAPES)}, or a mesh file ({', '.join(MESH_SUFFIXES)}, USD)"
            require(name in OBSTACLE_SHAPES or is_mesh_file(name), f"obstacle_shapes[{i}]", rule, name)
        require_kinds(self)
        require(len(self.materials) > 0, "materials", "a list with at least one material", list(self.materials))
        require(len(self.group_shapes) > 0, "group_shapes", "a list with at least one shape", [])
        rule = "a list with at least one shape if obstacle_count > 0"
        require(self.obstacle_count == 0 or len(self.obstacle_shapes) > 0, "obstacle_shapes", rule, [])

    @property
    def upright(self) -> bool:
        """Returns whether all scenes have the gravity of the settings."""
        return not self.kinds and self.zero_gravity_fraction == 0 and self.tilted_gravity_fraction == 0

    @property
    def drawn_materials(self) -> tuple[str, ...]:
        return (*dict.fromkeys((*self.materials, *({"elastic"} & {*self.own_physics}))),)


@dataclass(frozen=True)
class MpmConfig(Bounded):
    """The MLS-MPM solver. The defaults correct Taichi Elements; conf/mpm/taichi_elements.yaml reproduces it."""

    youngs_modulus_pa: Positive[float] = 1e6  # Young's modulus of all materials; stiffer ones need shorter steps
    # Poisson's ratio of all materials; the pressure of water follows from its Lame parameter lambda
    poisson_ratio: Annotated[float, Bound("in [0, 0.5)", lambda ratio: 0 <= ratio < 0.5)] = 0.2
    density_kg_m3: Positive[float] = 1000.0  # density of all materials at the start
    # Friction angle of sand; the default is that of quartz sand at its critical state (Bolton 1986).
    sand_friction_angle_deg: Annotated[NonNegative[float], Bound("< 90", lambda angle: angle < 90)] = 33.0
    # Diameter of grains. With it friction grows with the flow rate: mu(I) of Jop, Forterre and Pouliquen (2006). With
    # the default, the columns in the solver's checks are 200 grains in radius. 0: friction does not depend on the rate.
    sand_grain_diameter_m: NonNegative[float] = 0.0025
    snow_hardening: NonNegative[float] = 10.0  # exponent of the stiffness of compressed snow
    snow_critical_compression: BelowOne[float] = 0.025  # snow is elastic down to singular values of 1 minus this
    snow_critical_stretch: NonNegative[float] = 0.0045  # snow is elastic up to singular values of 1 plus this
    # Fraction of its tension that stretched water bears; 1 as in Taichi Elements.
    water_tension: AtMostOne[NonNegative[float]] = 1.0
    # Viscosity in addition to that of the grid, which is larger than that of real water.
    water_viscosity_pa_s: NonNegative[float] = 0.0
    # corrected, or taichi_elements: numerical choices of the paper's simulator (hgn/solver_method.py lists them).
    method: Annotated[str, one_of(*METHODS)] = "corrected"
    fixed_time_step_s: Positive[float] | None = None  # null: each scene takes steps as long as its materials allow
    # Adaptive steps as a fraction of a single particle's stability limit dx sqrt(rho / (3 lambda + 2 mu)).
    stability_fraction: AtMostOne[Positive[float]] = 0.875
    # Number of grid nodes at each face of the domain that stop outgoing motion. A grid with other cells needs another
    # number for walls at the same position.
    wall_cells: Annotated[int, Bound("at least 2, the reach of a particle", lambda count: count >= 2)] = 3
    device: DeviceName = "auto"  # cpu, cuda, or auto: cuda if there is a GPU
    scenes_per_launch: OneOrMore | None = None  # number of scenes in a launch; null: 1 on a CPU, up to 416 on a GPU

    @property
    def choices(self) -> SolverMethod:
        """Returns the numerical choices of the method."""
        return METHODS[self.method]


@dataclass(frozen=True)
class DatasetConfig:
    """The episodes of a data set: their number, length, folder and generation."""

    folder: FolderName = "data/obstacles"  # folder of shards, index and manifest; or a URL to read from
    training_scenes: NonNegative[int] = 800  # number of episodes of the split train
    validation_scenes: NonNegative[int] = 5  # number of episodes of the split validation
    test_scenes: NonNegative[int] = 20  # number of episodes of the split test
    frames: FrameCount = 300  # number of frames of an episode; frame 0 is the initial state
    long_fraction: Fraction[float] = 0.0  # fraction of each split's episodes, evenly distributed, with long_frames
    long_frames: FrameCount = 300  # number of frames of a long episode
    frame_rate_hz: FrameRate = 60.0  # frames per simulated second
    # cells per domain unit of a finer grid for simulation, with more particles; episodes contain only particles of the
    # grid of scene.cell_size; null: no finer grid
    reference_cells: OneOrMore | None = None
    seed: NonNegative[int] = 0  # seed of all scenes of the data set
    episodes_per_shard: Positive[int] = 8  # the first shards are smaller, so that training can start early
    workers: OneOrMore | None = None  # number of simulating processes; null: one per GPU, or per two cores of a CPU
    worker_silence_s: Positive[float] = 600.0  # seconds without progress after which a worker is replaced
    pool: Annotated[str, one_of("local", "ray")] = "local"  # local: processes of this machine; ray: of a Ray cluster
    # number of this generator, 0 to array_tasks - 1, as in a Slurm array; each generates its own shards in one folder
    array_task: int | None = None
    array_tasks: OneOrMore | None = None  # number of generators that write to one folder

    def __post_init__(self) -> None:
        require_bounds(self)
        task, tasks = self.array_task, self.array_tasks
        require((task is None) == (tasks is None), "array_task", "given together with array_tasks", [task, tasks])
        if task is not None and tasks is not None:
            require(0 <= task < tasks, "array_task", f"0 to {tasks - 1}, below array_tasks", task)

    @property
    def most_frames(self) -> int:
        """Returns the number of frames of the longest episode."""
        return max(self.frames, self.long_frames) if self.long_fraction > 0 else self.frames

    def frames_of(self, index: int) -> int:
        """Returns the number of frames of an episode by its index in its split."""
        long_before, long_with_it = (math.floor(count * self.long_fraction + 1e-9) for count in (index, index + 1))
        return self.long_frames if long_with_it > long_before else self.frames

    def scenes(self, split: str) -> int:
        return {"train": self.training_scenes, "validation": self.validation_scenes, "test": self.test_scenes}[split]


@dataclass(frozen=True, kw_only=True)
class SimulatorConfig:
    """Settings of all commands that simulate with a network."""

    device: str = "auto"  # auto (a GPU if there is one), cpu, cuda or cuda:1
    # torch, triton (kernels in CUDA graphs), cpu (compiled C); auto: the fastest one that is supported
    backend: BackendName = "auto"
    precision: PrecisionOrAuto = "auto"  # fp32, tf32 or fp16 products; auto: the fastest that passes its check


@dataclass(frozen=True)
class DatagenConfig:
    """`python -m datagen`: all settings that define a data set."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    mpm: MpmConfig = field(default_factory=MpmConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)

    def __post_init__(self) -> None:
        require_few_cells(self.scene.domain_size, self.reference_cell_size)
        if self.reference_ratio == 1:
            return
        cells, visible, name = 1 / self.reference_cell_size, 1 / self.scene.cell_size, "dataset.reference_cells"
        halves = 2 * self.reference_ratio
        rule = f"a multiple of {visible / 2:g}, half of the visible grid's cells per unit, and at least {visible:g}"
        require(halves > 2 and abs(halves - round(halves)) < 1e-6, name, rule, self.dataset.reference_cells)
        whole = all(abs(edge * cells - round(edge * cells)) < 1e-3 for edge in self.scene.domain_size)
        require(whole, name, "such that domain_size is a whole number of its cells", round(cells))
        step_s = self.mpm.fixed_time_step_s
        require(step_s is None, "mpm.fixed_time_step_s", f"null with {name}, which determines the step", step_s)

    @property
    def reference_cell_size(self) -> float:
        """Returns the cell size of the grid on which scenes are simulated."""
        cells = self.dataset.reference_cells
        return self.scene.cell_size if cells is None else 1 / cells

    @property
    def reference_ratio(self) -> float:
        """Returns the cell size of scenes divided by that of the grid on which they are simulated."""
        ratio = self.scene.cell_size / self.reference_cell_size
        return 1.0 if abs(ratio - 1) < 1e-6 else ratio

    @property
    def reference(self) -> dict[str, Any] | None:
        """Returns the record of the finer grid in a data set; None without a finer grid."""
        if self.reference_ratio == 1:
            return None
        children = round(self.reference_ratio**3)
        return {"cells": self.dataset.reference_cells, "particles_per_visible": children, "visible": "first child"}


@dataclass(frozen=True)
class NetworkConfig:
    """The hierarchical graph network (paper sec. 3.1, 3.2), or one to compare with it. Lengths are in domain units."""

    kind: Annotated[str, one_of(*NETWORK_KINDS)] = "hgn"  # hgn, or gns: Sanchez-Gonzalez et al. 2020, on backend torch
    cell_size: OrdinarySize = 0.035  # R: edge of the finest cells; the connectivity radius of GNS
    levels: FewLayers = 4  # L: number of levels; GNS has one, the particles
    message_passing_steps: FewLayers = 4  # M: message-passing steps in each of the 2 L - 1 blocks
    width: LayerSize = 128  # number of values in latent vectors and hidden layers
    velocity_history: FewLayers = 5  # m: number of past velocities in the input
    obstacle_features: bool = True  # normals of obstacle cells as inputs; false is only for scenes without obstacles
    obstacle_distance: bool = False  # distances up to two cells away in place of these (hgn.scene.surface_field)
    # absolute: the paper's velocities and wall distances; relative: hgn.network.relative, exact in free motion; local:
    # relative, and each body has cells of its own (hgn.network.grid)
    inputs: Annotated[str, one_of("absolute", "relative", "local")] = "absolute"
    materials: tuple[MaterialName, ...] = PAPER_MATERIALS  # each of the materials has its own embedding
    # number of dimensions; with 2, which only imported data have, z is constant
    dimensions: Annotated[int, Bound("2 or 3", lambda count: count in (2, 3))] = 3
    # additional inputs (hgn.network.own_physics): friction of surfaces, parameters of the materials, the deformation of
    # elastic bodies, and the motion of obstacles
    own_physics: OwnPhysics = ()

    def __post_init__(self) -> None:
        require_bounds(self)
        require(len(self.materials) > 0, "materials", "a list with at least one material", [])
        rule = "an empty list with inputs=absolute"
        require(self.relative or not self.own_physics, "own_physics", rule, list(self.own_physics))
        sees = self.relative and self.obstacle_features
        rule = "false with inputs=absolute or obstacle_features=false"
        require(sees or not self.obstacle_distance, "obstacle_distance", rule, True)
        whole = "elastic" in self.materials or "elastic" not in self.own_physics
        require(whole, "materials", "a list with elastic if own_physics contains it", list(self.materials))
        if self.relative:
            require(self.kind == "hgn", "inputs", f"absolute for {self.kind}", self.inputs)
            rule = f"at least 2 with inputs={self.inputs}, which use differences"
            require(self.velocity_history >= 2, "velocity_history", rule, self.velocity_history)
        if self.kind == "gns":
            require(self.levels == 1, "levels", "1 for gns: the particles themselves", self.levels)

    @property
    def relative(self) -> bool:
        """Returns whether inputs do not depend on a motion that all particles have in common."""
        return self.inputs != "absolute"

    @property
    def body_cells(self) -> bool:
        """Returns whether each body has cells of its own (hgn.network.grid)."""
        return self.inputs == "local"

    @property
    def feature_width(self) -> int:
        """Returns the number of inputs per particle, the embedding last (paper sec. 3.1, or hgn.network.relative)."""
        if self.relative:
            motion = 3 * (self.velocity_history - 1) + 3 * self.levels + 3
            return motion + 6 + 6 * self.obstacle_features + MATERIAL_EMBEDDING
        return 3 * self.velocity_history + 3 * self.obstacle_features + 6 + MATERIAL_EMBEDDING


# Number of plane waves in correlated noise, and the range of their lengths in finest cells. Short waves deform a
# body, long waves move it.
CORRELATED_WAVES, CORRELATED_WAVELENGTHS = 16, (4, 64)


@dataclass(frozen=True)
class TrainingConfig:
    """The training of a network (paper sec. 3.3)."""

    maximum_updates: Positive[int] = 20_000_000  # number of updates of the optimiser after which the training ends
    maximum_minutes: Positive[float] | None = None  # wall time after which this start ends, in minutes; null: no limit
    batch_scenes: Positive[int] = 1  # frames of random scenes in one update, on each device
    # adam, or muon (Jordan 2024): hidden matrices step along their orthogonalised momentum, all others as in Adam
    optimizer: Annotated[str, one_of("adam", "muon")] = "adam"
    learning_rate: Positive[float] = 1e-4  # learning rate of the first update after the warm-up
    final_learning_rate: Positive[float] = 1e-6  # learning rate at maximum_updates, after exponential decay
    # number of first updates with a linear increase of the rate, at most a fifth of maximum_updates
    warmup_updates: NonNegative[int] = 0
    # weights from which a new run starts (not a resumed one): a file of python -m hgn.export or a shipped name
    init_weights: str | None = None
    # decay per update of the parameters' average, which is monitored and exported, for example 0.9999; 0: none
    ema_decay: BelowOne[float] = 0.0
    noise_std: NonNegative[float] = 0.000848528  # input noise of the last velocity, domain units per frame
    # fraction of the noise's variance in waves of 4 to 64 cells, which neighbours have in common; the paper's is 0
    noise_correlated_fraction: Fraction[float] = 0.1
    # domain units per frame squared; frames of smaller rms acceleration a have this / a as loss weight, at most 4
    quiet_acceleration: NonNegative[float] = 0.0
    # fraction of samples drawn in proportion to their frames' acceleration, with loss weights for the expected loss
    frame_importance: BelowOne[float] = 0.0
    # folders of additional data sets, as published when the command starts. They need the same physics, frame rate,
    # solver cells and reference grid, known materials, and with absolute inputs the same gravity.
    more_data: tuple[str, ...] = ()
    # number of episodes whose samples are shuffled together, for data larger than the cache or the GPU's memory; 0: all
    shuffle_episodes: NonNegative[int] = 0
    # weight of the errors of cells' means in the loss, on each level, beside errors of particles; 0: none
    cell_mean_weight: NonNegative[float] = 0.0
    # gravity: samples are rotated and mirrored at random by the symmetries of gravity and domain; none: they are not
    symmetry: Annotated[str, one_of("none", "gravity")] = "none"
    # fraction of an update's samples from the network's own simulations, for example 0.25; 0: no simulations
    pushforward_fraction: BelowOne[float] = 0.0
    pushforward_every: Positive[int] = 500  # number of updates between these simulations
    pushforward_scenes: Positive[int] = 64  # scenes simulated together on each device, from random frames of the data
    pushforward_frames: Positive[int] = 16  # number of simulated frames, at most to the end of the episode
    # least number of simulated frames, as a fraction of the episode's; slow drifts show only in long simulations
    pushforward_episode_fraction: BelowOne[float] = 0.0
    # fraction of these samples drawn in proportion to their target acceleration, with loss weights that keep the
    # expected loss; 0: all are equally likely
    pushforward_importance: BelowOne[float] = 0.0
    seed: NonNegative[int] = 0  # seed of initial parameters, order of samples, noise and simulations
    device: DeviceName = "auto"  # cpu or cuda; auto: cuda if there is a GPU
    devices: OneOrMore | None = None  # devices on each machine; null: as launched, else all GPUs, or one CPU
    precision: PrecisionOrAuto = "auto"  # fp32, tf32 or fp16 products; auto: the fastest that passes its check
    # torch, or triton (kernels in CUDA graphs); auto: triton if it is supported
    backend: Annotated[str, one_of("auto", "torch", "triton")] = "auto"
    # number of published training episodes at which training starts; while its generator runs, it also waits for the
    # first validation episode
    minimum_episodes: Positive[int] = 1
    generate: bool = True  # whether to start the generator if the data set is missing or incomplete
    # loggers in addition to metrics.jsonl: tensorboard, wandb, mlflow; their variables name servers and projects
    loggers: tuple[Annotated[str, one_of(*LOGGERS)], ...] = ("tensorboard",)
    log_every: Positive[int] = 50  # number of updates between log lines; the last update has one too
    checkpoint_every: Positive[int] = 1_000  # number of updates between checkpoints
    # number of updates between measurements of one-step and rollout errors; the first interval is halved down to 2,000
    monitor_every: Positive[int] = 100_000
    monitor_rollout_frames: NonNegative[int] = 300  # number of frames of each measured rollout; 0: no rollouts

    def __post_init__(self) -> None:
        require_bounds(self)
        rule, last = f"at most learning_rate ({self.learning_rate})", self.final_learning_rate
        require(last <= self.learning_rate, "final_learning_rate", rule, last)


@dataclass(frozen=True)
class TrainConfig:
    """`python -m hgn.train`: the data set, the network, the training, and the run's folder."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    mpm: MpmConfig = field(default_factory=MpmConfig)
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    step: StepConfig = field(default_factory=StepConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    run: FolderName = "runs/obstacles"  # folder of checkpoints, logs and pictures
    # whether the data set was imported and determines `scene` and `dataset`, as with +experiment=imported
    imported: bool = False

    def __post_init__(self) -> None:
        require_bounds(self)
        self.step.require_fits(self.network.relative, self.network.dimensions)
        rule, dimensions = "3 for data that are not imported", self.network.dimensions
        require(self.imported or dimensions == 3, "network.dimensions", rule, dimensions)
        rule = "relative if scene.kinds are given, or zero_gravity_fraction or tilted_gravity_fraction is above 0"
        require(self.network.relative or self.scene.upright, "network.inputs", rule, self.network.inputs)
        rule, remedy = "true for scenes with obstacles", "or set scene.obstacle_count=0 scene.funnel_scene_fraction=0"
        sees = self.network.obstacle_features or self.scene.obstacle_count == 0
        require(sees, "network.obstacle_features", rule, False, remedy)
        mirrors, symmetry = self.network.relative and not self.step.rests, self.training.symmetry
        rule = "gravity with relative inputs and step.rest_threshold=0, which simulate mirrored frames"
        require(symmetry == "gravity" or not mirrors, "training.symmetry", rule, symmetry)
        weight, cells = self.training.cell_mean_weight, self.network.kind != "gns"
        require(cells or weight == 0, "training.cell_mean_weight", "0 for gns, which has no cells", weight)
        simulates, frames = self.training.pushforward_fraction > 0, self.dataset.frames
        rule = f"at least {SIMULATED_FRAMES} if training.pushforward_fraction > 0"
        require(not simulates or frames >= SIMULATED_FRAMES, "dataset.frames", rule, frames)
        names = () if self.imported else self.scene.drawn_materials
        unknown = [name for name in names if name not in self.network.materials]
        require(not unknown, "network.materials", "all of scene.materials", list(self.network.materials))

    @property
    def datagen(self) -> DatagenConfig:
        return DatagenConfig(self.scene, self.mpm, self.dataset)
