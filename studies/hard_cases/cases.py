"""The list of all hard cases."""

from __future__ import annotations

from studies.hard_cases.clouds import in_views
from studies.hard_cases.kinds import ScanCase, ViewCase, VoxelCase
from studies.hard_cases.scans import of_scans
from studies.hard_cases.unusable import unusable
from studies.hard_cases.voxels import on_voxels


def all_cases(steps: int = 300) -> list[ViewCase | VoxelCase | ScanCase]:
    """Every hard case. steps   of the fit to adversarial data"""
    return [*in_views(), *on_voxels(), *unusable(), *of_scans(steps)]
