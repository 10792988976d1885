"""Dr.Jit's LLVM and its threads."""

import os
import sys
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.common import runtime
from lingo_mi.common.runtime import calm_openmp, find_libllvm, restart_llvm, use_threads, warn_of_spinning


@pytest.fixture
def no_llvm(monkeypatch):
    monkeypatch.setenv('DRJIT_LIBLLVM_PATH', '')  # restored afterwards
    monkeypatch.setattr(sys, 'prefix', '/there_is_no_such_folder')
    monkeypatch.setattr(sys, 'path', ['site-packages', '/site-packages', '/there/site-packages'])


def test_folders_of_packages_with_few_folders_above(no_llvm):
    assert find_libllvm() is None


CARRIED = {  # the last one is taken
    'linux': ['lib/libLLVM-14.so', 'lib/libLLVM.so.16.0', 'lib/libLLVM.so', 'lib/libLLVM-19.so', 'lib/libLLVM.so.20.1'],
    'darwin': ['lib/libLLVM.14.dylib', 'lib/libLLVM.dylib', 'lib/libLLVM.20.1.dylib'],
    'win32': ['Library/bin/LLVM-C.dll'],
}


@pytest.mark.parametrize('system', CARRIED)
def test_the_newest_llvm_of_the_environment(no_llvm, monkeypatch, tmp_path, system):
    """It comes from pip's package on Linux, and from conda's on each system."""
    monkeypatch.setattr(sys, 'platform', system)
    monkeypatch.setattr(sys, 'prefix', str(tmp_path))
    monkeypatch.setattr(runtime, '_INSTALLED', {})
    for name in CARRIED[system]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert find_libllvm() == os.environ['DRJIT_LIBLLVM_PATH'] == str(tmp_path / CARRIED[system][-1])


def test_no_llvm_is_better_than_one_too_old(no_llvm, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, 'prefix', str(tmp_path))
    (tmp_path / 'lib').mkdir()
    (tmp_path / 'lib' / 'libLLVM.so.16.0').touch()
    assert find_libllvm() is None and not os.environ['DRJIT_LIBLLVM_PATH']


@pytest.mark.parametrize('system', ['darwin', 'win32'])
def test_llvm_of_an_installer(no_llvm, monkeypatch, tmp_path, system):
    monkeypatch.setattr(sys, 'platform', system)
    monkeypatch.setitem(runtime._INSTALLED, system, str(tmp_path / 'installed'))
    assert find_libllvm() is None
    (tmp_path / 'installed').touch()
    assert find_libllvm() == str(tmp_path / 'installed')


def test_an_old_llvm_that_cannot_be_exchanged(monkeypatch, tmp_path):
    """Dr.Jit's library has another name on Windows, so a warning says what to do."""
    monkeypatch.setenv('DRJIT_LIBLLVM_PATH', 'LLVM-C.dll')
    monkeypatch.setattr(dr.detail, 'llvm_version', lambda: (14, 0, 0))
    monkeypatch.setattr(dr, '__file__', str(tmp_path / '__init__.py'))
    with pytest.warns(UserWarning, match='runs on LLVM 14, .* or set DRJIT_LIBLLVM_PATH'):
        restart_llvm()


@pytest.mark.thorough
def test_threads_change_while_a_kernel_runs():
    """A kernel that adds to a copy of its result for every thread; without waiting for it, one change in a hundred crashes."""
    before, size, count = dr.thread_count(), 1 << 20, 1 << 21
    rounds = 1 if mi.variant().startswith('cuda') else 150  # its kernels need no threads of the CPU
    index = mi.UInt(np.random.default_rng(0).integers(0, size, count).astype(np.uint32))
    try:
        for threads in (1, 2) * rounds:
            use_threads(threads)
            sums = dr.zeros(mi.Float, size)
            dr.scatter_reduce(dr.ReduceOp.Add, sums, mi.Float(1), index, mode=dr.ReduceMode.Expand)
            dr.eval(sums)
            use_threads(3 - threads)
            assert dr.sum(sums)[0] == count
    finally:
        use_threads(before)


def test_openmp_sleeps_unless_pytorch_is_loaded(monkeypatch):
    """The variable is read once, when PyTorch is loaded. After that, only a warning can help."""
    monkeypatch.setattr(sys, 'modules', {name: module for name, module in sys.modules.items() if name != 'torch'})
    monkeypatch.delenv('OMP_WAIT_POLICY', raising=False)
    warn_of_spinning.cache_clear()
    calm_openmp()
    assert os.environ['OMP_WAIT_POLICY'] == 'passive'
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        warn_of_spinning()

    monkeypatch.setenv('OMP_WAIT_POLICY', 'active')  # the user's choice stays
    calm_openmp()
    assert os.environ['OMP_WAIT_POLICY'] == 'active'

    monkeypatch.delenv('OMP_WAIT_POLICY')
    sys.modules['torch'] = sys
    calm_openmp()
    assert 'OMP_WAIT_POLICY' not in os.environ
    warn_of_spinning.cache_clear()
    with pytest.warns(UserWarning, match='import lingo_mi before torch'):
        warn_of_spinning()
    with warnings.catch_warnings():  # once
        warnings.simplefilter('error')
        warn_of_spinning()
