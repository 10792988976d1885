"""Where Dr.Jit finds LLVM."""

import sys

from lingo_mi.runtime import find_libllvm


def test_folders_of_packages_with_few_folders_above(monkeypatch):
    monkeypatch.delenv('DRJIT_LIBLLVM_PATH', raising=False)
    monkeypatch.setattr(sys, 'prefix', '/there_is_no_such_folder')
    monkeypatch.setattr(sys, 'path', ['site-packages', '/site-packages', '/there/site-packages'])
    assert find_libllvm() is None
