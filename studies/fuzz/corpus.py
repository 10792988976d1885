"""Small good files of every format: what is mutated. Made from fixed numbers, so that a case's seed is the whole case."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

SHAPE = (4, 5, 6)
VALUES = np.random.default_rng(0).integers(0, 250, SHAPE).astype(np.uint8)
DENSITY = (VALUES / 250).astype(np.float32)
PROJECTIONS = np.random.default_rng(1).uniform(0.1, 2, (3, 4, 5)).astype(np.float32)
SCANNER: dict[str, Any] = dict(
    DSO=1000.0, DSD=1500.0, nDetector=[4, 5], dDetector=[2.0, 3.0], nVoxel=[4, 5, 6], dVoxel=[1.0, 1.5, 2.0],
    offOrigin=[1.0, 2.0, 3.0], offDetector=[10.0, 20.0], mode='cone',
)  # fmt: skip


@dataclass(frozen=True)
class Structured:
    """A file that is written from plain data, which may be mutated before it is written."""

    data: Any
    dump: Callable[[Any], bytes]

    def content(self) -> bytes:
        return self.dump(self.data)


@dataclass(frozen=True)
class Sample:
    """Files of one reader, by name below a folder; `target` is what the reader is given, the folder itself for ''."""

    target: str
    files: Mapping[str, bytes | Structured]


def npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(arrays: dict) -> bytes:
    return zipped({f'{name}.npy': npy(array) for name, array in arrays.items()})


def zipped(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, 'w') as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return stream.getvalue()


def as_json(data: Any) -> bytes:
    return json.dumps(data, default=_listed).encode()


def as_yaml(data: Any) -> bytes:
    class Dumper(yaml.SafeDumper):
        def ignore_aliases(self, data):
            return True

    return yaml.dump(json.loads(json.dumps(data, default=_listed)), Dumper=Dumper).encode('utf-8', 'surrogatepass')


def _listed(value):
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)


def volumes() -> dict[str, list[Sample]]:
    """Samples of `read_volume` by format."""
    import nibabel

    def nifti(image_class, dtype: Any = 'f4', slope: float = 1.0, **arguments):
        image = image_class(DENSITY.astype(dtype) if dtype == 'f4' else VALUES.astype(dtype), np.eye(4), **arguments)
        image.header.set_slope_inter(slope, 0)
        return image

    single = [nifti(nibabel.Nifti1Image), nifti(nibabel.Nifti2Image), nifti(nibabel.Nifti1Image, 'i2', 0.5)]
    pair = {name: holder.fileobj.getvalue() for name, holder in _saved_pair(nifti(nibabel.Nifti1Pair)).items()}
    raw = VALUES.tobytes('F')
    nrrd = (
        b'NRRD0004\ntype: uchar\ndimension: 3\nspace: left-posterior-superior\nsizes: 4 5 6\n'
        b'space directions: (1,0,0) (0,1,0) (0,0,2)\nkinds: domain domain domain\n'
    )
    meta = (
        b'ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = %s\n'
        b'TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 0 0\nElementSpacing = 1 1 2\nDimSize = 4 5 6\n'
        b'ElementType = MET_UCHAR\nElementDataFile = %s\n'
    )
    out = {
        'npy': [Sample('v.npy', {'v.npy': npy(a)}) for a in (VALUES, DENSITY, np.asfortranarray(DENSITY))],
        'npz': [Sample('v.npz', {'v.npz': npz(dict(volume=DENSITY, other=np.arange(3)))})],
        'nii': [Sample('v.nii', {'v.nii': image.to_bytes()}) for image in single],
        'nii.gz': [Sample('v.nii.gz', {'v.nii.gz': gzip.compress(i.to_bytes(), mtime=0)}) for i in single],
        'hdr, img': [Sample('v.hdr', {'v.hdr': pair['header'], 'v.img': pair['image']})],
        'nrrd': [
            Sample('v.nrrd', {'v.nrrd': nrrd + b'encoding: raw\n\n' + raw}),
            Sample('v.nrrd', {'v.nrrd': nrrd + b'encoding: gzip\n\n' + gzip.compress(raw, mtime=0)}),
            Sample('v.nhdr', {'v.nhdr': nrrd + b'encoding: raw\ndata file: v.raw\n\n', 'v.raw': raw}),
        ],
        'mha, mhd': [
            Sample('v.mha', {'v.mha': meta % (b'False', b'LOCAL') + raw}),
            Sample('v.mha', {'v.mha': meta % (b'True', b'LOCAL') + zlib.compress(raw)}),
            Sample('v.mhd', {'v.mhd': meta % (b'False', b'v.raw'), 'v.raw': raw}),
        ],
        'raw': [Sample('v.raw', {'v.raw': raw})],
    }
    return out | _zarr() | _tiff() | _dicom()


def _saved_pair(image) -> dict[str, Any]:
    maps = image.make_file_map({'header': io.BytesIO(), 'image': io.BytesIO()})
    image.to_file_map(maps)
    return maps


def _zarr():
    values, shape = VALUES.transpose(2, 1, 0), list(SHAPE[::-1])
    chunk = gzip.compress(values.tobytes(), mtime=0)
    axes = [dict(name=name, type='space', unit='millimeter') for name in 'zyx']
    placed = [dict(type='scale', scale=[2.0, 1.0, 1.0]), dict(type='translation', translation=[1.0, 2.0, 3.0])]
    image = dict(axes=axes, datasets=[dict(path='0', coordinateTransformations=placed)], version='0.4')
    group = dict(zarr_format=3, node_type='group', attributes=dict(ome=dict(version='0.5', multiscales=[image])))
    array = dict(
        zarr_format=3, node_type='array', shape=shape, data_type='uint8', fill_value=0, attributes={},
        chunk_grid=dict(name='regular', configuration=dict(chunk_shape=shape)),
        chunk_key_encoding=dict(name='default', configuration=dict(separator='/')),
        codecs=[dict(name='bytes'), dict(name='gzip', configuration=dict(level=5))],
    )  # fmt: skip
    older = dict(
        zarr_format=2, shape=shape, chunks=shape, dtype='|u1', fill_value=0, order='C', filters=None,
        compressor=dict(id='gzip', level=5),
    )  # fmt: skip
    third = {'zarr.json': Structured(group, as_json), '0/zarr.json': Structured(array, as_json), '0/c/0/0/0': chunk}
    second = {
        '.zattrs': Structured(dict(multiscales=[image]), as_json),
        '0/.zarray': Structured(older, as_json),
        '0/0.0.0': chunk,
        '.zgroup': as_json(dict(zarr_format=2)),
    }
    return {
        'ome-zarr': [
            Sample('v.zarr', {f'v.zarr/{name}': content for name, content in files.items()})
            for files in (third, second)
        ]
    }


def _tiff():
    import tifffile

    def tiff(array, **options):
        stream = io.BytesIO()
        tifffile.imwrite(stream, array, photometric='minisblack', **options)
        return stream.getvalue()

    stack = VALUES.transpose(2, 1, 0)
    images = [
        tiff(stack), tiff(stack, compression='zlib'), tiff(stack, imagej=True), tiff(stack, bigtiff=True),
        tiff(stack, metadata=None), tiff(np.tile(stack, (1, 16, 16)), tile=(16, 16), metadata=None),
        tiff(stack.astype('f4')),
    ]  # fmt: skip
    slices = {f's{z}.tif': tiff(image) for z, image in enumerate(stack)}
    return {'tiff': [*(Sample('v.tif', {'v.tif': image}) for image in images), Sample('', slices)]}


def _dicom():
    from pydicom import Dataset
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import UID, CTImageStorage, ExplicitVRLittleEndian

    files = {}
    for z in range(2):
        data = Dataset()
        data.file_meta = FileMetaDataset()
        data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID = CTImageStorage
        data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = UID(f'1.2.3.{z}')
        data.file_meta.ImplementationClassUID = UID('1.2.3')
        data.SeriesInstanceUID = '1.2.3'
        data.Rows, data.Columns, data.SamplesPerPixel = 5, 4, 1
        data.PhotometricInterpretation = 'MONOCHROME2'
        data.BitsAllocated = data.BitsStored = 16
        data.HighBit, data.PixelRepresentation = 15, 1
        data.PixelSpacing, data.SliceThickness = [1.0, 0.5], 9.0
        data.ImageOrientationPatient, data.ImagePositionPatient = [1, 0, 0, 0, 1, 0], [7, 8, 2.5 * z]
        data.RescaleSlope, data.RescaleIntercept = 2, -1000
        data.PixelData = VALUES[:, :, z].T.astype('<i2').tobytes()
        stream = io.BytesIO()
        data.save_as(stream, enforce_file_format=True)
        files[f's{z}.dcm'] = stream.getvalue()
    return {'dicom': [Sample('', files)]}


def scans() -> dict[str, list[Sample]]:
    """Samples of `read_scan` by format."""
    naf = SCANNER | dict(
        numTrain=3, numVal=3, image=DENSITY, totalAngle=180.0, startAngle=0.0, randomAngle=False, filter=None,
        train=dict(projections=PROJECTIONS, angles=np.arange(3.0)), val=dict(projections=PROJECTIONS, angles=np.arange(3.0)),
    )  # fmt: skip
    r2 = dict(scanner=SCANNER, bbox=[[-1, -1, -1], [1, 1, 1]], vol='v.npy') | {
        f'proj_{split}': [dict(file_path=f'{split}/{i}.npy', angle=float(i)) for i in range(3)]
        for split in ('train', 'test')
    }
    views = {f'{s}/{i}.npy': npy(PROJECTIONS[i]) for s in ('train', 'test') for i in range(3)}
    extra = dict(input='intensity', I0=5.0, valid='m.npy')
    poses = [[0.0, 900, 0, 0, -500, 0, 1, 0, 0, 0, 0, -1]] * 3
    posed = {name: value for name, value in SCANNER.items() if name not in ('DSO', 'DSD', 'offDetector')}
    turned = dict(rotDetector=[1.0, 2, 3], COR=1.0, tilt=[1.0, 2, 3], pitch=3.0, DSO=[1000.0, 1001, 1002])
    geometries = [
        SCANNER,
        SCANNER | extra | dict(angles=[0.0, 10, 20]),
        SCANNER | turned,
        posed | dict(poses=poses),
        posed | dict(poses='p.xml'),
    ]
    htc = dict(sinogram_ta=PROJECTIONS[0], DSO=410.0, DSD=553.0, dDetector=0.2, angles_deg=np.arange(4.0))
    walnut = dict(
        projections=PROJECTIONS, DSO=210.0, DSD=553.0, dDetector=[0.4, 0.4], angles=np.arange(3.0), air=np.float32(0.1)
    )
    mask = npy(np.ones((3, 4, 5), bool))
    geometry = Structured(SCANNER, as_yaml)
    return {
        'zarr, yml': [
            Sample('s.zarr', {f's.zarr/{name}': part for name, part in files.items()} | {'s.yml': geometry})
            for files in _chunked_projections()
        ],
        'hdf5, yml': [
            Sample('s.h5', {'s.h5': _hdf5(chunks, packed), 's.yml': geometry})
            for chunks, packed in ((None, None), ((1, 4, 5), None), ((2, 4, 5), 'gzip'))
        ],
        'naf': [
            Sample('s.pickle', {'s.pickle': Structured(naf, lambda d, p=p: pickle.dumps(d, p))}) for p in (0, 2, 4, 5)
        ],
        'r2': [Sample('', {'meta_data.json': Structured(r2, as_json), 'v.npy': npy(DENSITY), **views})],
        'npy, yml': [
            Sample('s.npy', {'s.npy': npy(PROJECTIONS), 's.yml': Structured(g, as_yaml), 'm.npy': mask, 'p.xml': RTK})
            for g in geometries
        ],
        'public scans': [Sample('s.npz', {'s.npz': npz(data)}) for data in (htc, walnut)],
        'exr folder': [
            Sample(
                '',
                {
                    'geometry.yml': Structured(SCANNER | dict(angles=[0.0, 10, 20]), as_yaml),
                    **{f'train/{i}.exr': exr(image) for i, image in enumerate(PROJECTIONS)},
                },
            )
        ],
    }


def _chunked_projections():
    """Files of a Zarr array in chunks of two views, Zarr 3 and 2, with packed chunks and without."""
    views = [PROJECTIONS[:2], np.stack([PROJECTIONS[2], np.zeros((4, 5), np.float32)])]
    shape, chunks = [3, 4, 5], [2, 4, 5]
    for packed in (False, True):
        parts = [gzip.compress(part.tobytes(), mtime=0) if packed else part.tobytes() for part in views]
        third = dict(
            zarr_format=3, node_type='array', shape=shape, data_type='float32', fill_value=0, attributes={},
            chunk_grid=dict(name='regular', configuration=dict(chunk_shape=chunks)),
            chunk_key_encoding=dict(name='default', configuration=dict(separator='/')),
            codecs=[
                dict(name='bytes', configuration=dict(endian='little')),
                *[dict(name='gzip', configuration=dict(level=5))] * packed,
            ],
        )  # fmt: skip
        second = dict(
            zarr_format=2, shape=shape, chunks=chunks, dtype='<f4', fill_value=0, order='C', filters=None,
            compressor=dict(id='gzip', level=5) if packed else None,
        )  # fmt: skip
        yield {'zarr.json': Structured(third, as_json)} | {f'c/{i}/0/0': part for i, part in enumerate(parts)}
        yield {'.zarray': Structured(second, as_json)} | {f'{i}.0.0': part for i, part in enumerate(parts)}


def _hdf5(chunks, compression) -> bytes:
    import h5py

    stream = io.BytesIO()
    with h5py.File(stream, 'w') as file:
        file.create_dataset(
            'exchange/data', data=PROJECTIONS, chunks=chunks, compression=compression, track_times=False
        )
    return stream.getvalue()


RTK = (
    b'<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">\n'
    b'<SourceToIsocenterDistance>1000</SourceToIsocenterDistance>\n'
    b'<SourceToDetectorDistance>1500</SourceToDetectorDistance>\n'
    + b''.join(
        b'<Projection><GantryAngle>%d</GantryAngle><ProjectionOffsetX>1.5</ProjectionOffsetX>'
        b'<Matrix>1 0 0</Matrix></Projection>\n' % i
        for i in range(3)
    )
    + b'</RTKThreeDCircularGeometry>\n'
)


def exr(image: np.ndarray) -> bytes:
    from lingo_mi.files.images import write_exr

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'v.exr')
        write_exr(path, image)
        return path.read_bytes()


def others() -> dict[str, list[Sample]]:
    """Samples of the other readers, by their names."""
    from lingo_mi.files.ply import write_ply

    rng = np.random.default_rng(2)
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder, 'c.ply')
        write_ply(ply, rng.normal(size=(5, 3)), np.ones((5, 3)), np.tile([0.0, 0, 0, 1], (5, 1)), np.ones(5))
        vectors = np.array([[0.0, 900, 0, 0, -500, 0, 1, 0, 0, 0, 0, -1]] * 3)
        table = '\n'.join(' '.join(map(str, row)) for row in vectors).encode()
        matrices = np.tile(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 900]]), (3, 1, 1))
        return {
            'ply': [Sample('c.ply', {'c.ply': ply.read_bytes()})],
            'exr': [Sample('v.exr', {'v.exr': exr(np.tile(PROJECTIONS[0], (4, 4)))})],
            'poses': [
                Sample('p.xml', {'p.xml': RTK}),
                Sample('p.txt', {'p.txt': table}),
                Sample('p.npy', {'p.npy': npy(vectors)}),
                Sample('p.npy', {'p.npy': npy(matrices)}),
            ],
            'checkpoint': _checkpoints(),
        }


def _checkpoints():
    """Make checkpoints as they are written, and as entries that get a right checksum after a mutation, so that the reader goes
    further."""
    from lingo_mi.fitting.checkpoint import Checkpoint
    from lingo_mi.fitting.methods.lingo import LINGO
    from lingo_mi.fitting.start.start import StartingCloud
    from lingo_mi.geometry.base import Geometry

    geometry = Geometry.cone(DSO=10, DSD=15, nDetector=4, dDetector=1, nVoxel=4, dVoxel=1, angles=np.arange(3) / 2)
    method = LINGO().changed(average=0.5)
    state = method.starting_state(StartingCloud(np.full((5, 3), 0.5), np.ones(5), np.full(5, 0.1)), 1.0)
    arrays = {'initial': np.ones((5, 3), np.float32), 'order': np.arange(3), 'losses': np.ones(3)}
    arrays |= {f'average.{name}': value for name, value in state.values.items()}
    checkpoint = Checkpoint(
        method, geometry, 1.0, state, arrays, seed=0, rng=dict(np.random.default_rng(0).bit_generator.state), iteration=7,
        seconds=1.5, history=[dict(iteration=7, seconds=1.0, loss=0.5, gaussians=5)], info={},
        scan=dict(views=3, signal=0.5, moments=[0.25, 0.25, 0.25], valid=None, effects=None), effects=False, search=None,
        seen=3,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'c.npz')
        checkpoint.save(path)
        written, entries = path.read_bytes(), dict(np.load(path))
    del entries['checksum']
    entries['extra'] = json.loads(str(entries['extra']))
    return [Sample('c.npz', {'c.npz': Structured(entries, _checkpoint)}), Sample('c.npz', {'c.npz': written})]


def _checkpoint(entries: dict) -> bytes:
    """The file of these entries, with a right checksum."""
    from lingo_mi.fitting.checkpoint import checksum_of

    entries = entries | dict(extra=np.array(json.dumps(entries.get('extra'), default=_listed)))
    members = {name: npy(value) for name, value in entries.items()}
    checksum = checksum_of((name, zlib.crc32(content)) for name, content in members.items())
    return zipped({f'{name}.npy': content for name, content in (members | dict(checksum=npy(checksum))).items()})


SCENE = b"""<scene version="3.0.0">
    <default name="views" value="3"/>
    <default name="cloud" value="c.ply"/>
    <integrator type="lingo_xray"/>
    <shape type="ellipsoids"><string name="filename" value="$cloud"/></shape>
    <sensor type="ct_scanner">
        <float name="DSO" value="10"/>
        <float name="DSD" value="15"/>
        <string name="nDetector" value="4, 5"/>
        <string name="dDetector" value="2, 2"/>
        <string name="nVoxel" value="4, 5, 6"/>
        <string name="dVoxel" value="1"/>
        <integer name="views" value="$views"/>
    </sensor>
</scene>
"""


def scenes() -> dict[str, list[Sample]]:
    """Scenes of the package's plugins, with a cloud beside them."""
    ply = others()['ply'][0].files['c.ply']
    return {'scene': [Sample('s.xml', {'s.xml': SCENE, 'c.ply': ply})]}
