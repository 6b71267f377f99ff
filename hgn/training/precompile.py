"""Lists the kernels that a training compiles while the first episodes are generated."""

from hgn.config import SceneConfig, TrainConfig
from hgn.kernels.update.op import UpdateSettings
from hgn.runtime.precompile_program import PrecompileJob


def job_of_training(config: TrainConfig, capability: tuple[int, int], several_ranks: bool) -> PrecompileJob:
    """Returns the kernels that a training on such a GPU needs. The distribution of scenes determines their sizes."""
    training, network = config.training, config.network
    particles, cells = _sizes(config.scene, network.levels)
    return PrecompileJob(
        network,
        UpdateSettings.of(training, config.scene.cell_size),
        training.precision,
        several_ranks,
        averages=training.ema_decay > 0,
        particles=training.batch_scenes * particles,
        cells=tuple(training.batch_scenes * count for count in cells),
        capability=10 * capability[0] + capability[1],
    )


def _sizes(scene: SceneConfig, levels: int) -> tuple[int, list[int]]:
    """Returns the numbers of initial particles and of cells on each level, for a scene whose groups are cubes."""
    edge = scene.group_size / scene.cell_size
    particles = scene.group_count * scene.particles_per_cell * edge**3
    cells, length = [], edge + 2  # neighbours of a particle's cell are active too
    for _ in range(levels):
        cells.append(max(1, round(scene.group_count * length**3)))
        length = (length + 1) / 2
    return max(1, round(particles)), cells
