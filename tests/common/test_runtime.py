"""Where Dr.Jit finds LLVM, and its threads."""

import os
import sys
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.common.runtime import calm_openmp, find_libllvm, use_threads, warn_of_spinning


def test_folders_of_packages_with_few_folders_above(monkeypatch):
    monkeypatch.delenv('DRJIT_LIBLLVM_PATH', raising=False)
    monkeypatch.setattr(sys, 'prefix', '/there_is_no_such_folder')
    monkeypatch.setattr(sys, 'path', ['site-packages', '/site-packages', '/there/site-packages'])
    assert find_libllvm() is None


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
    """It is read once, as PyTorch is loaded: later, only a warning can help."""
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
