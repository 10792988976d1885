"""Measures every stage along every axis, one factor of ten after the other, in a process a stage."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import astuple, replace

from lingo_mi.common.errors import InputError, brief
from studies.growth.stages import DEPENDS, Size

BASE = Size(voxels=64, pixels=128, views=20, gaussians=10_000)
FIELDS: dict[str, str] = dict(voxels='voxels', pixels='pixels', views='views', Gaussians='gaussians')
SIDES: dict[str, int] = dict(voxels=3, pixels=2)  # axes that sizes give by a side, and the sides that multiply
# Each about ten times the one before, in numbers of voxels, pixels, views and Gaussians.
SIZES: dict[str, tuple[int, ...]] = dict(
    voxels=(32, 69, 149, 320),
    pixels=(64, 202, 640, 2024),
    views=(4, 40, 400),
    Gaussians=(1000, 10_000, 100_000, 1_000_000),
)
SHORT: dict[str, int] = dict(voxels=3, pixels=3, views=3, Gaussians=3)  # of these sizes, unless all are wanted


def number(axis: str, value: int) -> int:
    """Return the number of voxels, pixels, views or Gaussians that a value of `SIZES` stands for."""
    return value ** SIDES.get(axis, 1)


def sizes(axis: str, large: bool) -> list[int]:
    """The values of an axis. large: all of them, which takes half an hour of CPU time instead of minutes."""
    return list(SIZES[axis] if large else SIZES[axis][: SHORT[axis]])


def planned(stage: str, large: bool) -> list[tuple[str, int]]:
    """Return the measurements of a stage: pairs of an axis and a value of `SIZES`."""
    return [(axis, value) for axis in DEPENDS[stage] for value in sizes(axis, large)]


def sweep(large: bool, stored: list[dict], after_each: Callable[[list[dict], list[dict]], object]) -> list[dict]:
    """Measurements: stage, axis, number, seconds of CPU time, peak in bytes.

    Parameters
    ----------
    stored : list[dict]
        Measurements of before; a stage that is whole there is not measured again.
    after_each : callable
        Called after every stage with all measurements so far, and those stored that they do not replace.

    Raises
    ------
    InputError
        If a stage fails.
    """
    rows: list[dict] = []
    for stage in DEPENDS:
        wanted = [(axis, number(axis, value)) for axis, value in planned(stage, large)]
        reused = [row for row in stored if row['stage'] == stage and (row['axis'], row['number']) in wanted]
        rows += reused if len(reused) == len(wanted) else _measured(stage, planned(stage, large))
        new = [(row['stage'], row['axis'], row['number']) for row in rows]
        after_each(rows, [row for row in stored if (row['stage'], row['axis'], row['number']) not in new])
    return rows


def _measured(stage: str, plan: list[tuple[str, int]]) -> list[dict]:
    words = [astuple(replace(BASE, **{FIELDS[axis]: value})) for axis, value in plan]
    command = [sys.executable, '-m', 'studies.growth.stages', stage]
    command += [','.join(map(str, word)) for word in words]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ['it was killed'])[-1]
        raise InputError(f'{stage}: {brief(last, 200)}')
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{')]
    return [dict(stage=stage, axis=axis, number=number(axis, value)) | line for (axis, value), line in zip(plan, lines)]


def exponent(rows: list[dict], key: str) -> float:
    """The law at the large end: the slope of log cost over log number between the last two rows."""
    first, last = rows[-2:]
    return math.log(max(last[key], 1e-9) / max(first[key], 1e-9)) / math.log(last['number'] / first['number'])
