"""DICOM files of projections, written by the standards' own attributes, and rays by their own formulas."""

import numpy as np


def balls(sources, targets, spheres):
    """Line integrals from `sources` to `targets` [..., 3] through balls (x, y, z, radius, density)."""
    along = targets - sources
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    total = np.zeros(np.broadcast_shapes(sources.shape, targets.shape)[:-1])
    for *centre, radius, density in spheres:
        off = np.array(centre) - sources
        distance = (off**2).sum(-1) - (off * along).sum(-1) ** 2
        total += density * 2 * np.sqrt(np.maximum(radius**2 - distance, 0))
    return total


class CTPD:
    """A helical scan of DICOM-CT-PD, positions by the formulas of its user manual; `flying` moves the focal spot."""

    rho, distance, rows, columns, across, along = 595.0, 1085.6, 12, 40, 4.0, 4.0
    column, row = 21.125, 6.0  # the central element, counted from 1

    def __init__(self, views=90, turns=3.0, pitch=18.0, flying=False, shape='CYLINDRICAL'):
        k = np.arange(views)
        self.phi, self.shape = 0.3 + 2 * np.pi * turns * k / views, shape
        self.z = -150 + pitch * turns * (k / views - 0.5)
        swing = np.where(k % 2, 1.0, -1.0) * flying
        self.turn, self.lift, self.back = 0.002 * swing, 0.6 * swing, 1.5 * swing

    @staticmethod
    def point(rho, phi, z):
        return np.stack(np.broadcast_arrays(-rho * np.sin(phi), rho * np.cos(phi), z), -1)

    def sources(self):
        return self.point(self.rho + self.back, self.phi + self.turn, self.z + self.lift)

    def elements(self):
        """[view, row, column, 3]."""
        i, j = np.arange(1, self.columns + 1) - self.column, np.arange(1, self.rows + 1) - self.row
        centre = self.point(self.rho, self.phi, self.z)[:, None, None]
        inwards = self.point(-1.0, self.phi, 0.0)[:, None, None]
        left = np.cross([0, 0, 1.0], inwards)  # of who looks from the focal centre to the panel, z up
        s = (i * self.across)[:, None]
        turn = s / self.distance
        flat = inwards * self.distance + left * s
        bent = self.distance * (np.cos(turn) * inwards + np.sin(turn) * left)
        z = np.array([0, 0, 1.0]) * (-j * self.along)[:, None, None]
        return centre + (bent if self.shape == 'CYLINDRICAL' else flat) + z

    def projections(self, spheres):
        return balls(self.sources()[:, None, None], self.elements(), spheres)

    def write(self, folder, projections, direct=False, without=(), implicit=False):
        """One file a view; `without` names of tags to leave out, `implicit`: values of unknown type."""
        import pydicom

        folder.mkdir()
        slope = (projections.max() + 0.1) / 60000
        for k, view in enumerate(projections):
            ds = _dataset(pydicom, implicit)
            ds.InstanceNumber, ds.Modality = k + 1, 'CT'
            stored = np.rint((view + 0.1) / slope).astype('<u2')  # intercept: air may be below zero
            stored = stored if direct else stored.T
            _pixels(ds, stored, 16)
            ds.RescaleSlope, ds.RescaleIntercept = f'{slope:.10g}', '-0.1'
            for group, creator in (
                (0x7029, 'DetectorSystemArrangementModule'),
                (0x7031, 'DetectorDynamicsModule'),
                (0x7033, 'SourceDynamicsModule'),
            ):
                ds.add_new((group, 0x10), 'LO', creator)
            for tag, vr, value in (
                (0x70291010, 'US', self.rows),
                (0x70291011, 'US', self.columns),
                (0x70291002, 'FL', self.across),
                (0x70291006, 'FL', self.along),
                (0x7029100B, 'CS', self.shape),
                (0x70311001, 'FL', float(np.mod(self.phi[k], 2 * np.pi))),
                (0x70311002, 'FL', self.z[k]),
                (0x70311003, 'FL', self.rho),
                (0x70311031, 'FL', self.distance),
                (0x70311033, 'FL', [self.column, self.row]),
                (0x7033100B, 'FL', self.turn[k]),
                (0x7033100C, 'FL', self.lift[k]),
                (0x7033100D, 'FL', self.back[k]),
            ):
                if tag not in without:
                    ds.add_new(tag, vr, value)
            _save(ds, folder / f'{len(projections) - k:04d}.dcm')  # InstanceNumber tells the order, not the names


def write_xa(path, counts, primary, secondary=None, steps=None, without=(), **attributes):
    """A run [n, v, u] of a C-arm: first angles and increments in degrees (a vector, or one step)."""
    import pydicom

    ds = _dataset(pydicom)
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = '1.2.840.10008.5.1.4.1.1.12.1'  # X-Ray Angiographic
    ds.Modality, ds.PixelIntensityRelationship = 'XA', 'LIN'
    ds.DistanceSourceToDetector, ds.DistanceSourceToPatient, ds.ImagerPixelSpacing = 1200, 750, [0.8, 0.6]
    ds.PositionerPrimaryAngle = primary
    if secondary is not None:
        ds.PositionerSecondaryAngle = secondary
    if len(counts) > 1:
        ds.NumberOfFrames, ds.PositionerMotion = len(counts), 'DYNAMIC'
        ds.PositionerPrimaryAngleIncrement = steps
    for name, value in attributes.items():
        setattr(ds, name, value)
    for name in without:
        delattr(ds, name)
    _pixels(ds, counts if len(counts) > 1 else counts[0], 12)
    _save(ds, path)


def _dataset(pydicom, implicit=False):
    meta = pydicom.dataset.FileMetaDataset()
    meta.MediaStorageSOPClassUID = '1.2.840.10008.5.1.4.1.1.7'
    meta.MediaStorageSOPInstanceUID = pydicom.uid.generate_uid()
    meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian if implicit else pydicom.uid.ExplicitVRLittleEndian
    ds = pydicom.dataset.Dataset()
    ds.file_meta = meta
    ds.SOPClassUID, ds.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    return ds


def _pixels(ds, stored, bits):
    ds.Rows, ds.Columns = stored.shape[-2:]
    ds.SamplesPerPixel, ds.PhotometricInterpretation, ds.PixelRepresentation = 1, 'MONOCHROME2', 0
    ds.BitsAllocated, ds.BitsStored, ds.HighBit = 16, bits, bits - 1
    ds.PixelData = stored.astype('<u2').tobytes()


def _save(ds, path):
    ds.save_as(path, enforce_file_format=True)
