"""Scene files that would end the process, or never end, are refused before Mitsuba sees them."""

import contextlib
import os
import signal

import pytest

from helpers.script import SCENE
from lingo_mi.common.errors import InputError, brief
from lingo_mi.scene import outline as limits
from lingo_mi.scene.data_files import data_file
from lingo_mi.scene.load import defaults, load_scene
from lingo_mi.scene.outline import outline
from lingo_mi.scene.shipped import scenes


def nested(depth, tag='shape type="sphere"'):
    return f'<scene version="3.0.0">{f"<{tag}>" * depth}{f"</{tag.split()[0]}>" * depth}</scene>'


@pytest.fixture
def refused(tmp_path):
    """The one line by which a scene of some text or bytes is refused."""

    def refused(content, path=tmp_path / 'scene.xml'):
        if content is not None:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(InputError) as caught:
            load_scene(path)
        message = str(caught.value)
        assert message.isprintable() and len(brief(message)) < 300
        return message

    return refused


@pytest.mark.parametrize('tag', ['shape type="sphere"', 'scene', 'transform name="to_world"', 'x'])
def test_too_deep(refused, tag):
    for depth in (limits.MOST_DEPTH, 30_000):
        assert 'within each other' in refused(nested(depth, tag))


def test_too_many_elements(refused, tmp_path):
    assert 'at most' in refused(f'<scene version="3.0.0">{"<shape/>" * limits.MOST_ELEMENTS}</scene>')
    (tmp_path / 'part.xml').write_text(f'<scene version="3.0.0">{"<shape/>" * 3000}</scene>')
    again = '<include filename="part.xml"/>' * 10
    assert 'at most' in refused(f'<scene version="3.0.0">{again}</scene>')


def test_too_large(refused, tmp_path):
    with open(tmp_path / 'large.xml', 'wb') as file:
        file.truncate(limits.MOST_BYTES + 1)
    assert 'has 64 MiB' in refused(None, tmp_path / 'large.xml')


def test_entities(refused):
    bomb = '<!DOCTYPE s [<!ENTITY a "aaaaaaaaaa">' + ''.join(
        f'<!ENTITY {name} "{f"&{before};" * 10}">' for before, name in zip('abcdefghi', 'bcdefghij')
    )
    assert 'document type' in refused(f'{bomb}]><scene version="3.0.0"><default name="x" value="&j;"/></scene>')
    outside = '<!DOCTYPE s [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
    assert 'document type' in refused(f'{outside}<scene version="3.0.0">&a;</scene>')


@pytest.mark.parametrize('encoding', ['utf-16', 'utf-7', 'cp037', 'idna', 'no such', 'base64'])
def test_encodings(refused, encoding):
    """If Mitsuba took a file for another encoding, it would show another scene."""
    assert refused(f'<?xml version="1.0" encoding="{encoding}"?>' + SCENE)


def test_bytes(refused):
    for content in (b'', b'\0' * 9, b'\xff' * 9, SCENE.encode('utf-32'), b'<' * 9):
        assert 'not a scene' in refused(content)


@pytest.mark.posix
def test_devices_and_pipes(refused, tmp_path):
    os.mkfifo(tmp_path / 'pipe.xml')
    os.symlink('/dev/zero', tmp_path / 'link.xml')
    for name in ('pipe.xml', 'link.xml'):
        assert 'a device or a pipe' in refused(None, tmp_path / name)
        assert 'a device or a pipe' in refused(f'<scene version="3.0.0"><include filename="{name}"/></scene>')
        for tag in ('shape type="ply"', 'shape type="ellipsoids"', 'texture type="bitmap"', 'volume type="gridvolume"'):
            text = f'<{tag}><string name="filename" value="{name}"/></{tag.split()[0]}>'
            assert 'not a regular file' in refused(f'<scene version="3.0.0">{text}</scene>')
        with pytest.raises(InputError, match='not a regular file'):
            data_file(str(tmp_path / name), 'volume')


def test_included_files(refused, tmp_path):
    (tmp_path / 'below').mkdir()
    (tmp_path / 'below' / 'deep.xml').write_text(nested(30_000))
    includes = (
        '<include filename="below/deep.xml"/>',
        f'<include filename="{tmp_path}/below/deep.xml"/>',
        '<path value="below"/><include filename="deep.xml"/>',
        '<default name="part" value="below/deep"/><include filename="$part.xml"/>',
    )
    for text in includes:
        assert 'within each other' in refused(f'<scene version="3.0.0">{text}</scene>')
    (tmp_path / 'other.xml').write_text(
        '<scene version="3.0.0"><default name="part" value="x"/><include filename="$part"/></scene>'
    )
    with pytest.raises(InputError, match='within each other'):
        load_scene(tmp_path / 'other.xml', {'part': 'below/deep.xml'})
    assert 'files deep' in refused('<scene version="3.0.0"><include filename="scene.xml"/></scene>')
    assert 'none.xml' in refused('<scene version="3.0.0"><include filename="none.xml"/></scene>')


def test_what_scenes_have(tmp_path):
    """Long attributes, comments and other scenes are all let through."""
    for path in scenes().values():
        outline(path)
    (tmp_path / 'part.xml').write_text('<scene version="3.0.0"><bsdf type="diffuse" id="paint"/></scene>')
    text = SCENE.replace('<integrator', '<!-- a part --><include filename="part.xml"/>\n<integrator', 1)
    angles = f'<string name="angles" value="1, 2,{" " * 3_000_000}3"/>'
    text = text.replace('<integer name="views" value="$views"/>', angles)
    (tmp_path / 'scene.xml').write_text('<?xml version="1.0" encoding="UTF-8"?>' + text)
    assert len(load_scene(tmp_path / 'scene.xml').scanner.geometry) == 3
    assert defaults(tmp_path / 'scene.xml') == {'views'}


def test_ctrl_c_while_a_scene_loads(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr('lingo_mi.plugins.ct_volume.make', stop)
    (tmp_path / 'scene.xml').write_text(SCENE)
    with pytest.raises(KeyboardInterrupt):
        load_scene(tmp_path / 'scene.xml')


@pytest.mark.parametrize('then', [None, ValueError('something else')])
def test_ctrl_c_that_a_plugin_swallows(tmp_path, monkeypatch, then):
    """It comes as a signal, as from a terminal; the plugin goes on, or makes another error of it."""
    from lingo_mi.plugins import ct_volume

    make = ct_volume.make

    def stop(*arguments):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        if then:
            raise then
        return make(*arguments)

    monkeypatch.setattr(ct_volume, 'make', stop)
    (tmp_path / 'scene.xml').write_text(SCENE)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        load_scene(tmp_path / 'scene.xml')
    assert signal.getsignal(signal.SIGINT) is before


def test_a_name_that_is_not_utf_8(tmp_path):
    path = tmp_path / os.fsdecode(b'\xff.xml')
    path.write_text(SCENE)
    with pytest.raises(InputError, match='names are UTF-8'):
        load_scene(path)


SCANNER = SCENE[: SCENE.index('<shape')] + SCENE[SCENE.index('</shape>') + len('</shape>') :]  # which takes no time
EXTREME = '1e308', '-1e308', '1e300', '9' * 400, '1e-300', 'nan', 'inf', '', 'x', '0x10', '1' * 6000


@pytest.mark.parametrize(
    'old', ['name="DSO" value="100"', 'name="DSD" value="150"', 'value="32, 40"', 'value="1.8, 1.8"', 'value="24, 24, 24"',
            'value="1, 1, 1"', 'value="$views"', 'name="test_views" value="3"'],
)  # fmt: skip
def test_extreme_numbers(refused, old):
    assert SCANNER.count(old) == 1
    for value in EXTREME:
        assert refused(SCANNER.replace(old, old[: old.rindex('value=')] + f'value="{value}"'))


@pytest.mark.parametrize(
    'name', ['offDetector', 'offOrigin', 'rotDetector', 'pitch', 'tilt', 'startAngle', 'totalAngle']
)
def test_extreme_placement(refused, name):
    kind = 'string' if name.startswith(('off', 'rot')) else 'float'
    for value in EXTREME:
        three = (
            f'{value}, 0, 0' if name in ('offOrigin', 'rotDetector') else f'{value}, 0' if kind == 'string' else value
        )
        if not (value in ('1e-300', '') and name != 'offOrigin') and (value, name) != ('1e-300', 'offOrigin'):
            more = f'<{kind} name="{name}" value="{three}"/>'
            assert refused(SCANNER.replace('<integer name="test_views"', more + '<integer name="test_views"'))


@pytest.mark.parametrize('shape', ['ply', 'ellipsoids'])
def test_ply_files_without_elements(refused, tmp_path, shape):
    """Mitsuba's readers ask for the first element."""
    for content in (b'ply\nformat binary_little_endian 1.0\nend_header\n', b'', b'ply\n'):
        (tmp_path / 'a.ply').write_bytes(content)
        text = f'<shape type="{shape}"><string name="filename" value="a.ply"/></shape>'
        assert 'a.ply: is a damaged PLY file' in refused(f'<scene version="3.0.0">{text}</scene>')
