"""The medium `ct_volume`: a CT volume or a phantom as Mitsuba's own heterogeneous medium."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files.volumes import read_volume
from lingo_mi.phantoms import make
from lingo_mi.scene.data_files import data_file


def create(props: mi.Properties) -> mi.Object:
    r"""
    .. _medium-ct_volume:

    CT volume (:monosp:`ct_volume`)
    -------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A CT volume: NIfTI, NRRD, MHA/MHD, NPY/NPZ, a TIFF stack or a DICOM folder (see `lingo_mi.files.volumes`). It
         is looked for beside the scene, then in the folder that the environment variable LINGO_MI_DATA names.
     * - phantom
       - |string|
       - Instead of a file: `foot`, `chest`, `shepp_logan`, `gaussians` or `mesh`.
     * - size
       - |int|
       - Voxels along the phantom's sides. (Default: 256)
     * - seed
       - |int|
       - Seed of the phantom's random texture. (Default: 0)
     * - attenuation
       - |string|
       - Of a phantom: `x3d`, densities in [0, 1], as in X3D's scenes; no scanner measures line integrals as large as theirs. Or
         `real`, these times 0.0618 per mm, dense cortical bone at 60 keV. (Default: x3d)
     * - mu_water
       - |float|
       - Attenuation of water in 1/mm, for a file in HU; without it HU are mapped to densities in [0, 1].
     * - scale
       - |float|
       - Factor of all values. (Default: 1)
     * - to_world
       - |transform|
       - Where the volume is: as for a `gridvolume`, the voxels fill the unit cube of its local frame. The voxel
         size in the file is *not* used; the scanner's grid says where the volume lies.

    It loads the values and hands them to Mitsuba's `heterogeneous` medium with a `gridvolume`; everything else
    (rendering with volume path tracers, `mi.traverse`, gradients) is Mitsuba's own. Place it in a shape of type `cube`.
    """
    get: Any = props.get
    filename, phantom = get('filename', ''), get('phantom', '')
    size, seed = get('size', 256), get('seed', 0)
    attenuation = get('attenuation', 'x3d')
    mu_water, scale = get('mu_water', 0.0), get('scale', 1.0)
    for key, value, kinds in (
        ('filename', filename, str),
        ('phantom', phantom, str),
        ('attenuation', attenuation, str),
        ('mu_water', mu_water, (int, float)),
        ('scale', scale, (int, float)),
    ):
        if not isinstance(value, kinds):
            raise InputError(f'ct_volume: {key} = {value!r} is of the wrong type')
    if not math.isfinite(scale):
        raise InputError(f'ct_volume: scale must be finite, not {scale}')
    to_world = props.get('to_world', mi.ScalarTransform4f())
    if bool(filename) == bool(phantom):
        raise InputError('ct_volume needs either a filename or a phantom')
    if phantom and mu_water:
        raise InputError('ct_volume: mu_water is for a file in Hounsfield units; give a phantom attenuation = real')
    if filename and attenuation != 'x3d':
        raise InputError('ct_volume: attenuation is for a phantom; a file in Hounsfield units takes mu_water')
    if phantom:
        data = make(phantom, size, seed, attenuation).data
    else:
        data = read_volume(data_file(filename, 'volume'), mu_water=mu_water or None).data
    grid = np.ascontiguousarray(data.transpose(2, 1, 0))[..., None]
    volume = dict(type='gridvolume', grid=mi.VolumeGrid(grid), to_world=to_world, raw=True)
    return mi.load_dict(dict(type='heterogeneous', sigma_t=volume, scale=scale, albedo=0.0, id=props.id()))
