"""The memory that this process may take: control groups as Linux shows them, and limits of address space, in one line."""

import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from helpers.script import FIT, SCENE
from lingo_mi.common import memory
from lingo_mi.common.gpu import GPU, resident_warps


def test_limits_of_control_groups(tmp_path):
    """The limits of the group and of all groups around it hold; in a container a group's own path may be missing."""

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    v2 = write('v2', '0::/job/step\n')
    write('cgroup/job/step/memory.max', 'max\n')
    write('cgroup/job/memory.max', '1000000\n')
    write('memory.max', '5\n')  # above where groups are mounted: none of ours
    assert memory._control_groups(v2, tmp_path / 'cgroup') == [1e6]
    v1 = write('v1', '5:cpu,cpuacct:/job\n4:memory:/elsewhere\n')
    write('cgroup/memory/memory.limit_in_bytes', '2000000\n')
    assert memory._control_groups(v1, tmp_path / 'cgroup') == [2e6]
    assert memory._control_groups(tmp_path / 'none', tmp_path) == []


def test_without_control_groups_and_limits(monkeypatch):
    """The memory of the machine is known without control groups, for example on Windows."""
    monkeypatch.setitem(sys.modules, 'resource', None)
    monkeypatch.setattr(memory, '_control_groups', lambda: [])
    assert memory.host_room() == psutil.virtual_memory().total


@pytest.mark.skipif(not Path('/proc/self/statm').exists(), reason='limits the address space, as Linux can')
def test_too_little_address_space_is_one_line(tmp_path):
    (tmp_path / 'scene.xml').write_text(SCENE.replace('value="24, 24, 24"', 'value="1000, 1000, 1000"'))
    command = [
        sys.executable,
        FIT.with_name('reconstruct.py'),
        tmp_path / 'scene.xml',
        '--variant',
        'llvm_ad_mono',
        '--out',
        tmp_path / 'v.nii',
    ]
    done = subprocess.run(
        ['bash', '-c', 'ulimit -v 10000000; exec "$@"', 'bash', *map(str, command)], capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stderr.startswith('error: ') and done.stderr.count('\n') == 1, done.stderr
    assert 'GiB of memory' in done.stderr


def test_on_a_gpu_its_memory_counts(monkeypatch, variant):
    if not variant.startswith('cuda'):
        monkeypatch.setattr('mitsuba.variant', lambda: 'cuda_ad_mono')
        monkeypatch.setattr(memory, 'gpu', lambda: GPU('a card', 3 << 30, 8, 48, 86, 1e9, 1e9))
        assert memory.room() == 3 << 30
    else:
        assert memory.room() == memory.gpu().memory > 1 << 28
        assert memory.gpu().name and resident_warps() >= memory.gpu().multiprocessors > 0
