"""Modules that remember the arguments of their constructor."""

from kornia_pnpnet import MLPInit


class Wide(MLPInit):
    """A subclass with other arguments."""

    def __init__(self, kilopixels):
        super().__init__(9, img_scale=1000.0 * kilopixels)


def test_a_subclass_has_the_config_of_the_constructor_that_it_calls():
    assert Wide(2).config == MLPInit(9, img_scale=2000.0).config
    assert "img_scale=2000.0" in repr(Wide(2))
