"""What adding a material relies on; hgn.scene.material lists the files."""

from datagen.mpm.layout import MATERIAL_VARIANTS, VARIANT, has_solid
from hgn.render.renderer import MATERIAL_COLORS
from hgn.scene.material import FLUIDS, MATERIAL_BITS, MATERIAL_MASK, MATERIALS


def test_labels_keep_scene_and_material():
    """A fifth material does not spill into the scene of the solver's labels, nor do a million scenes into it."""
    assert len(MATERIALS) < MATERIAL_MASK  # one more fits
    for scene in (0, 1, 10**6):
        for material in range(MATERIAL_MASK + 1):
            label = (scene << MATERIAL_BITS) + material
            assert (label >> MATERIAL_BITS, label & MATERIAL_MASK) == (scene, material) and label < 2**31


def test_each_material_is_complete():
    """Each has its look; what is no fluid is a solid: a kernel keeps deformation gradients if it is compiled for a
    material outside of FLUIDS, whatever else it has."""
    assert len(MATERIAL_COLORS) == len(MATERIALS) and set(FLUIDS) <= set(range(len(MATERIALS)))
    other = VARIANT.contact | VARIANT.sweep | VARIANT.several_laws
    for material, bit in enumerate(MATERIAL_VARIANTS):
        assert bit.bit_count() == 1 and has_solid(bit | other) == (material not in FLUIDS)
