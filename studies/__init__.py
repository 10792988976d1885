"""Measurements behind the documentation, run from a checkout. The package neither needs nor installs them.

Each is a command, `python -m studies.NAME --help`:

- `as_csv`: the tables of a page that a study has written, as data
- `bench_recon`: reconstruction on voxels, timed beside RTK and diffct
- `bench_step`: a step of a fit, timed part by part
- `box_voxels`: a scan of voxels that are boxes
- `cuda_check`: the CUDA backend if there is no GPU
- `effects`: what modelling an effect of real projections is worth
- `explain`: which errors of a scanner explain the error of a reconstruction
- `fuzz`: mutated files for every reader
- `growth`: time and memory as voxels, pixels, views and Gaussians grow
- `hard_cases`: needles, grazing rays, coincident Gaussians: cases at the limits of float32
- `noise`: what an early stop and weights are worth to a fit of noisy projections
- `on_a_gpu`: what needs an NVIDIA GPU, in nine minutes
- `peers`: volumes of one scan by this package, RTK and MBIRJAX
- `recipes`: quality of fits against time
- `regret`: how far the choice of `best` is behind the best fixed setting
- `start_times`: times of the starts of LINGO and of R2-Gaussian
- `tables`: the paper's tables on simulated scans
"""
