"""Which process of pytest-xdist runs which tests: a file's all in one, and all that simulate, long files first.

A file's fixtures are made once then, and the solver's kernels compiled once.
"""

from xdist.scheduler import LoadScopeScheduling

LONGEST_FILES = (  # five seconds and more of one core; begun last, one of them would run alone
    *("solver", "generator", "viewer/test_page", "training/test_ddp", "jobs/test_jobs"),
    *("runtime/test_exported_step", "docs/test_notebooks", "kernels/test_triton_compat"),
    *("network/test_network", "datagen/test_command", "datagen/test_pool"),
    *("runtime/test_differentiable", "kernels/test_rollout"),
    *("tools/test_bench", "end_to_end/test_bad_input", "kernels/test_training", "kernels/test_kernels_alone"),
    *("datagen/test_kills", "training/test_train", "scene/test_hostile_files", "scene/test_random_scene"),
    *("end_to_end/test_wheel", "tools/test_scaling"),
    *("tools/test_error_vs_time", "kernels/test_update", "jobs/test_queue"),
    *("datagen/test_service", "training/test_resume", "training/test_live_service", "kernels/test_memory"),
    *("test_command", "kernels/test_symmetry", "kernels/test_network", "training/test_precompile"),
    *("test_defaults", "data/test_import", "cpu/test_rows", "kernels/test_pushforward"),
    *("docs/test_pages", "data/test_index"),
)
SIMULATING = ("datagen/test_fine_reference", "datagen/test_world_data", "tools/test_gallery")
GENERATING = ("training/test_generator", "docs/test_tutorials")  # water around a solid
PLACES = {name: number for number, name in enumerate(LONGEST_FILES)}


def group_of(nodeid):
    """What runs in one process: a file, all that simulate, or all that generate the same kind of scene."""
    path = nodeid.split("::", 1)[0].removeprefix("tests/").removesuffix(".py")
    if path.startswith(("datagen/mpm/", "tools/test_stability")) or path in SIMULATING:
        return "solver"
    return "generator" if path in GENERATING else path


def place_of(nodeid):
    """Where its group stands in the order of the run."""
    return PLACES.get(group_of(nodeid), len(PLACES))


class FileScheduling(LoadScopeScheduling):
    """Hands out groups as the tests are ordered; `--dist loadgroup` hands out single tests with pytest 9.2."""

    def _split_scope(self, nodeid):
        return group_of(nodeid)

    def schedule(self):
        """Groups stay in the tests' order, which xdist sorts by their number otherwise."""
        self.config.option.loadscopereorder = False
        super().schedule()
