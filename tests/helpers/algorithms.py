"""What tests share with iterative."""

from lingo_mi.reconstruction.asd_pocs import asd_pocs
from lingo_mi.reconstruction.cgls import cgls
from lingo_mi.reconstruction.sart import os_sart, sart, sirt

ALGORITHMS = dict(sart=sart, os_sart=os_sart, sirt=sirt, cgls=cgls, asd_pocs=asd_pocs)
