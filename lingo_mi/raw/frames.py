"""Files and folders of raw frames: TIFF, EDF, RTK's and .npy here, others in files of their own."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path

import numpy as np

from lingo_mi.common.errors import InputError
from lingo_mi.files import arrays
from lingo_mi.files.hdf5_views import SUFFIXES
from lingo_mi.files.slices import by_number, read_tiff_file, require_chain
from lingo_mi.raw import dicom, hdf5, pictures, zeiss
from lingo_mi.raw.recording import Frames, Recording, checked
from lingo_mi.storage.file_access import one_line, optional, reading


def open_recording(path: PathLike | str) -> Recording:
    """Opens raw frames; nothing but the first frame is read.

    Parameters
    ----------
    path : path-like
        A folder of images of one kind of IMAGES, in the order of the numbers in their names, or of DICOM files; or a file of one
        kind of FILES: .npy [n, v, u], HDF5 as NXtomo (image_key) or DXchange (/exchange/data), a scanner's own.

    Raises
    ------
    InputError
        If the path is missing or unknown, or a package is needed that is not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        return _folder(path)
    with reading(path):
        open(path, 'rb').close()
    if suffix in FILES:
        return checked(path, lambda: FILES[suffix](path))
    if dicom.is_dicom(path):
        return checked(path, lambda: dicom.open_file(path))
    if suffix in IMAGES:
        raise InputError(f'{path}: is one frame; give the folder of the frames')
    raise InputError(
        f'{path}: is not a known file of frames; give a folder of images or of DICOM files, or one of {", ".join(FILES)}'
    )


def _folder(path):
    with reading(path, folder=True):
        inside = list(path.iterdir())
    files = sorted((f for f in inside if f.suffix.lower() in IMAGES), key=by_number)
    if not files:
        if series := [f for f in inside if dicom.is_dicom(f)]:
            return checked(path, lambda: dicom.open_dicom(path, series))
        raise InputError(f'{path}: holds no {", ".join(IMAGES)} images nor DICOM files; give the folder of the frames')
    first = checked(path, lambda: _image(files[0]))

    def read(i):
        image = _image(files[i])
        if image.shape != first.shape:
            raise InputError(
                f'{files[i]}: has the shape {image.shape}, but {files[0].name} has {first.shape}; all frames need one panel'
            )
        return image

    return Recording(Frames(str(path), len(files), first.shape, first.dtype, read))


def _image(path):
    image = IMAGES[path.suffix.lower()](path)
    if image.ndim != 2 or image.size == 0:
        raise InputError(
            f'{path}: is damaged, or not an image of one channel (its shape is {image.shape}); copy it again'
        )
    return image


def _rtk_image(path):
    itk = optional('itk', 'reference')
    if not hasattr(itk, 'RTK'):  # asking for RTK loads it, and ITK learns its formats
        raise InputError(f"{path}: needs RTK: pip install '.[reference]' in a checkout of lingo_mi")
    return np.asarray(itk.imread(str(path)))


def _edf_image(path):
    with optional('fabio').open(str(path)) as file:
        return _whole(path, file)


def _stack(path, count, frame):
    first = frame(0)
    return Recording(Frames(str(path), count, first.shape, first.dtype, frame))


def _edf(path):
    file = optional('fabio').open(str(path))
    return _stack(path, file.nframes, lambda i: _whole(path, file.get_frame(i)))


def _whole(path, frame):
    """The image of one of fabio's frames, which would fill up what is missing of it."""
    if getattr(frame, 'incomplete_data', False):
        raise InputError(f'{path}: is cut off: it holds less than its header says; copy it again')
    return np.asarray(frame.data)


def _tiff(path):
    require_chain(path)
    tifffile = optional('tifffile')
    file = tifffile.TiffFile(path)
    whole = file.series[0]
    if len(file.pages) == 1 and whole.ndim == 3 and whole.axes.endswith('YX'):  # as ImageJ writes more than 4 GB
        stack = tifffile.memmap(path, mode='r')
        return _stack(path, len(stack), lambda i: stack[i])
    return _stack(path, len(file.pages), lambda i: file.pages[i].asarray())


def _array(path):
    try:
        with reading(path):
            stack = np.load(path, mmap_mode='r', allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise InputError(f'{path}: is damaged or not a NumPy file ({one_line(error)[:120]}); write it again') from None
    if not isinstance(stack, np.ndarray) or stack.ndim != 3:
        raise InputError(f'{path}: is not an array [n, v, u]; write the frames with numpy.save')
    arrays.numeric(stack[:1], path, 3, finite=False)
    return Recording(Frames(str(path), len(stack), stack.shape[1:], stack.dtype, lambda i: stack[i]))


# Readers by suffix: of one image of a folder, and of a file that holds a whole recording.
IMAGES: dict[str, Callable[[Path], np.ndarray]] = {
    **dict.fromkeys(('.tif', '.tiff'), read_tiff_file),
    '.edf': _edf_image,
    **dict.fromkeys(pictures.SUFFIXES, pictures.read_picture),
    **dict.fromkeys(('.his', '.hnd', '.hnc', '.xim'), _rtk_image),  # Elekta's and Varian's
}
FILES: dict[str, Callable[[Path], Recording]] = {
    '.npy': _array,
    **dict.fromkeys(('.tif', '.tiff'), _tiff),
    '.edf': _edf,
    **dict.fromkeys(zeiss.SUFFIXES, zeiss.open_txrm),
    **dict.fromkeys(dicom.SUFFIXES, dicom.open_file),
    **dict.fromkeys(SUFFIXES, hdf5.open_hdf5),
}
