"""PTX through `ptxas`, NVIDIA's assembler: registers, spills and errors of every kernel.

It comes with `pip install nvidia-cuda-nvcc-cu12` or a CUDA toolkit, and needs no GPU.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from lingo_mi.common.errors import InputError


@dataclass(frozen=True)
class Kernel:
    """Result of assembling one entry of a module.

    Parameters
    ----------
    name : str
        Name of the entry.
    test : str
        A test file that compiled it.
    sm : int
        Compute capability times ten that it was assembled for.
    lines : int
        PTX instructions of its module.
    registers : int
        A thread's.
    spilled : int
        Bytes of registers that are stored in memory and loaded again.
    error : str or None
        Why it was not assembled; None.
    """

    name: str
    test: str
    sm: int
    lines: int
    registers: int = 0
    spilled: int = 0
    error: str | None = None

    @property
    def ours(self) -> bool:
        """True if it is compiled from a program's operations. Dr.Jit's own kernels, such as matrix products, are fixed."""
        return self.name.startswith('drjit_')

    @property
    def fails(self) -> bool:
        """True if it does not assemble, or spills and could be written otherwise."""
        return self.error is not None or self.ours and self.spilled > 0


def find_ptxas() -> Path:
    """The assembler: of the package nvidia-cuda-nvcc-cu12, or on PATH.

    Raises
    ------
    InputError
        If there is none.
    """
    places = [Path(p) / 'nvidia/cuda_nvcc/bin/ptxas' for p in sys.path] + [Path(shutil.which('ptxas') or 'ptxas')]
    for place in places:
        if place.is_file():
            return place
    raise InputError('there is no ptxas: pip install nvidia-cuda-nvcc-cu12')


def assemble(module: Path, sm: int, test: str = '') -> list[Kernel]:
    """The kernels of a PTX file, assembled for a compute capability times ten. test   the test file that they are from"""
    text = module.read_text(encoding='utf-8')
    names = re.findall(r'\.entry\s+([\w$]+)', text)
    lines = sum(line.rstrip().endswith(';') and not line.lstrip().startswith('.') for line in text.splitlines())
    with tempfile.TemporaryDirectory() as folder:
        command = [find_ptxas(), '-v', '-O3', f'-arch=sm_{sm}', module, '-o', Path(folder) / 'kernel.cubin']
        done = subprocess.run(command, capture_output=True, text=True)
    output = done.stdout + done.stderr
    if done.returncode:
        reason = next(
            (line.strip() for line in output.splitlines() if 'error' in line or 'fatal' in line), output.strip()
        )
        return [Kernel(name, test, sm, lines, error=reason) for name in names]
    out = []
    for name in names:
        part = output.partition(f"Compiling entry function '{name}'")[2].partition('Compiling entry function')[0]
        stores, loads = re.search(r'(\d+) bytes spill stores, (\d+) bytes spill loads', part).groups()  # type: ignore
        registers = re.search(r'Used (\d+) registers', part)
        out.append(Kernel(name, test, sm, lines, int(registers[1]) if registers else 0, int(stores) + int(loads)))
    return out
