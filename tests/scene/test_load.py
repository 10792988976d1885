"""Loading a scene: Mitsuba's errors in one line."""

from lingo_mi.scene.load import plain


def test_a_driver_without_optix_is_one_helpful_line():
    error = RuntimeError(
        '[parser.cpp:1718] At "a.xml" (line 4, col 2): failed to instantiate scene plugin of type "scene": '
        'Could not initialize OptiX!'
    )
    assert '\n' not in plain(error) and 'OptiX' in plain(error) and '--variant llvm_ad_mono' in plain(error)
