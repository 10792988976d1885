"""Memory that each algorithm takes at its peak, over that of the volume and all projections, as tests/test_recon_memory.py
measures it on volumes of half a gigabyte."""

COPIES = {'fdk': 2.7, 'sart': 2.7, 'os-sart': 2.7, 'sirt': 2.7, 'cgls': 4.3, 'asd-pocs': 5., 'refined': 7.4}
